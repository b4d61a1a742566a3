#include "kernels/stokes/flow_inverse.h"

#include "kernels/seconds.h"
#include "kernels/subscript.h"

namespace diffsim {
namespace {

// Of a direct solve: corrections by the factor, and the relative residual that rounding leaves.
constexpr int kMostCorrections = 5;
constexpr double kRoundingOfSolve = 1e-12;

/// Where the iterative path begins to be the faster one, by measurement: in two dimensions beyond
/// what fits into memory.
template <int D>
bool choose_iterative(const FlowOptions& options, std::int64_t num_nodes) {
  if (options.solver != FlowSolver::kAuto) return options.solver == FlowSolver::kIterative;
  return D == 3 && (options.incompressible || num_nodes > options.max_direct_nodes);
}

}  // namespace

template <int D>
FlowInverse<D>::FlowInverse(const FlowSpace<D>& space, StokesPlan& plan, ThreadPool& pool,
                            FlowReport& report, double start)
    : space_(space), report_(report), memory_(plan.memory()) {
  const FlowMatrix<D> matrix(op(), pool);
  report.geometry_s = seconds() - start;
  report.num_nodes = matrix.num_nodes();
  report.iterative = choose_iterative<D>(options(), matrix.num_nodes());
  if (report.iterative)
    prepare_iterative(matrix, pool);
  else
    factorize(matrix, plan, pool);
}

template <int D>
FlowInverse<D>::~FlowInverse() {
  if (factor_) memory_->give_back(factor_->take_memory());
}

template <int D>
void FlowInverse<D>::factorize(const FlowMatrix<D>& matrix, StokesPlan& plan, ThreadPool& pool) {
  const double start = seconds();
  factor_ = std::make_unique<CholeskyFactor>(matrix.analyze(space_.fixed(), plan),
                                             FactorPrecision::kFloat64, memory_->take());
  const double analysis_end = seconds();
  {
    const std::vector<double> values =
        matrix.assemble(space_.fixed(), options().bulk, matrix.own_rows(), pool);
    report_.assembly_s = seconds() - analysis_end;
    try {
      factor_->refactor(values.data(), pool);
    } catch (const NotPositiveDefinite& e) {
      const std::int64_t node = space_.geometry().active_nodes()[u(e.unknown / D)];
      throw NotPositiveDefinite(node * D + e.unknown % D, e.pivot);
    }
    if (options().incompressible)
      pressures_ = std::make_unique<FlowPressures<D>>(space_, matrix, values, pool);
  }
  report_.factor_s = seconds() - analysis_end - report_.assembly_s;
  report_.analysis_s = analysis_end - start;
  report_.factor_nnz = factor_->nnz();
  report_.factor_bytes = factor_->bytes();
  report_.solver_bytes = report_.factor_bytes + (pressures_ ? pressures_->bytes() : 0);
  report_.factor_flops = factor_->flops();
}

template <int D>
void FlowInverse<D>::prepare_iterative(const FlowMatrix<D>& matrix, ThreadPool& pool) {
  const double start = seconds();
  try {
    mixed_ = std::make_unique<FlowMixed<D>>(op(), space_.closed(), matrix, space_.fixed(), pool);
  } catch (const NotPositiveDefinite& e) {
    throw NotPositiveDefinite(-1, e.pivot);  // an unknown of a coarse grid means nothing outside
  }
  report_.assembly_s = seconds() - start;
  report_.solver_bytes = mixed_->bytes();
}

template <int D>
void FlowInverse<D>::take_mass(const FlowResidual& residual, std::int64_t k, const Forced& forced,
                               double* C) const {
  residual.mass(k, C);
  if (!options().incompressible) return;
  space_.skip_rigid(C);
  space_.closed().subtract(forced[u(k)], C);
}

template <int D>
void FlowInverse<D>::take_excess(const FlowResidual& residual, std::int64_t k, const Forced& forced,
                                 double eta, const double* p, double* C) const {
  take_mass(residual, k, forced, C);
  const ClosedRegions<D>& closed = space_.closed();
  const double bulk = options().bulk * eta;
  if (!options().incompressible) {
    for (std::int64_t cell = 0; cell < grid().num_cells; ++cell)
      C[cell] += op().pressure_volume(cell) * p[cell] / bulk;
    return;
  }
  const auto sum = closed.sums([&](const auto& c) { return c.volume * p[c.cell]; });
  for (const auto& c : closed.cells())
    C[c.cell] += c.volume * sum[u(c.region)] / (bulk * closed.weight(c.region));
}

template <int D>
double FlowInverse<D>::size_of(double eta, const double* r, const double* C) const {
  const double h = grid().h_min;
  double largest = 0.0, sum = 0.0;
  const auto for_all = [&](const auto& f) {
    space_.for_active([&](std::int64_t i, std::int64_t) {
      if (!space_.fixed(i)) f(h * std::abs(r[i]));
    });
    for (std::int64_t cell = 0; cell < grid().num_cells; ++cell)
      if (space_.geometry().active(cell)) f(eta * std::abs(C[cell]));
  };
  for_all([&](double x) { largest = x > largest || std::isnan(x) ? x : largest; });
  if (!(largest > 0.0) || std::isinf(largest)) return largest;
  for_all([&](double x) { sum += (x / largest) * (x / largest); });  // may be below 1e-160
  return largest * std::sqrt(sum);
}

template <int D>
void FlowInverse<D>::solve(std::int64_t cases, double eta, const FlowResidual& residual,
                           const Forced& forced, double* v, double* p, FlowStats* stats,
                           ThreadPool& pool) {
  if (mixed_) {
    solve_mixed(cases, eta, residual, forced, v, p, stats, pool);
    const bool converged =
        std::all_of(stats, stats + cases, [](const FlowStats& s) { return s.converged != 0.0; });
    if (converged || options().solver != FlowSolver::kAuto || !fall_back(pool)) return;
    space_.clear_free(cases, v);
    std::fill(p, p + cases * grid().num_cells, 0.0);
    for (std::int64_t k = 0; k < cases; ++k)
      stats[k] = {0.0, 0.0, 1.0, stats[k].net_inflow, 0.0, 0.0};
  }
  solve_direct(cases, eta, residual, forced, v, p, stats, pool);
}

/// A factor in place of an iterative solver that did not converge; false where there is none.
template <int D>
bool FlowInverse<D>::fall_back(ThreadPool& pool) {
  StokesPlan plan;  // this pattern is an exception
  try {
    factorize(FlowMatrix<D>(op(), pool), plan, pool);
  } catch (const NotPositiveDefinite&) {
    factor_.reset();
    return false;
  }
  mixed_.reset();
  report_.iterative = false;
  return true;
}

/// The residual of both equations tells whether the factor's answer is corrected by another.
template <int D>
void FlowInverse<D>::solve_direct(std::int64_t cases, double eta, const FlowResidual& residual,
                                  const Forced& forced, double* v, double* p, FlowStats* stats,
                                  ThreadPool& pool) {
  const std::int64_t N = grid().num_nodes * D, M = grid().num_cells;
  std::vector<double> r(u(N * cases)), C(u(M)), given(u(cases));
  for (std::int64_t k = 0; k < cases; ++k) {
    take_mass(residual, k, forced, C.data());
    residual.momentum(k, nullptr, r.data() + k * N);
    given[u(k)] = size_of(eta, r.data() + k * N, C.data());
    stats[k].num_iters = 0.0;
  }
  for (int round = 0;; ++round) {
    correct(cases, eta, residual, forced, r.data(), v, p, stats, pool);
    bool again = false;
    for (std::int64_t k = 0; k < cases; ++k) {
      take_excess(residual, k, forced, eta, p + k * M, C.data());
      residual.momentum(k, p + k * M, r.data() + k * N);
      const double left = size_of(eta, r.data() + k * N, C.data());
      const double relative = left > 0.0 || std::isnan(left) ? left / given[u(k)] : 0.0;
      const bool less = round == 0 || relative < 0.5 * stats[k].residual;
      again = again || (relative > options().rtol && less && stats[k].converged != 0.0);
      stats[k].residual = relative;
    }
    if (again && round < kMostCorrections) continue;
    for (std::int64_t k = 0; k < cases; ++k)
      if (!(stats[k].residual <= std::max(options().rtol, kRoundingOfSolve)))
        stats[k].converged = 0.0;
    return;
  }
}

/// K dv = b with the pressures' corrections eliminated, -(bulk / M) (C(v + dv, g) + ...); then,
/// where incompressible, C(v + dv, g) is driven to zero. C of dv is taken alone: that of v + dv
/// would be rounded to more than is left.
/// @param r (cases, num_nodes, D) the first equation's left side at v and p, used up
template <int D>
void FlowInverse<D>::correct(std::int64_t cases, double eta, const FlowResidual& residual,
                             const Forced& forced, double* r, double* v, double* p,
                             FlowStats* stats, ThreadPool& pool) {
  const std::int64_t N = grid().num_nodes * D, M = grid().num_cells;
  const bool strict = options().incompressible;
  const double bulk = options().bulk * eta;
  std::vector<double> mass(u(M)), C(u(M)), pressure(u(M)), excess(u(M * cases)),
      b(space_.num_unknowns() * u(cases)), dv(u(N * cases), 0.0), remainder(u(M * cases));
  for (std::int64_t k = 0; k < cases; ++k) {
    double* left = excess.data() + k * M;
    take_excess(residual, k, forced, eta, p + k * M, left);
    std::fill(pressure.begin(), pressure.end(), 0.0);
    space_.add_pressure(-bulk, left, pressure.data());
    op().add_pressure_force(pressure.data(), r + k * N, pool);
    space_.gather(r + k * N, b.data(), k, cases, -1.0 / eta);
  }
  const FactorSolve solve = [&](double* x, std::int64_t columns) {
    factor_->solve(x, x, static_cast<int>(columns), workspace_, pool);
  };
  solve(b.data(), cases);
  for (std::int64_t k = 0; k < cases; ++k) {
    double* left = remainder.data() + k * M;
    space_.scatter_add(b.data(), k, cases, 1.0, dv.data() + k * N);
    take_mass(residual, k, forced, mass.data());
    op().outflow(dv.data() + k * N, nullptr, C.data(), pool);
    for (std::int64_t cell = 0; cell < M; ++cell) left[cell] = -(mass[u(cell)] + C[u(cell)]);
    if (strict) space_.closed().subtract(space_.closed().means(left), left);
    stats[k].num_iters += 1.0;
  }
  if (strict) pressures_->close(eta, cases, solve, v, dv.data(), p, remainder.data(), stats, pool);
  for (std::int64_t k = 0; k < cases; ++k) {
    op().outflow(dv.data() + k * N, nullptr, C.data(), pool);
    for (std::int64_t cell = 0; cell < M; ++cell) C[u(cell)] += excess[u(k * M + cell)];
    space_.add_pressure(-bulk, C.data(), p + k * M);
    for (std::int64_t i = 0; i < N; ++i) v[k * N + i] += dv[u(k * N + i)];
    if (!strict)
      stats[k].divergence = space_.divergence(remainder.data() + k * M, space_.speed(v + k * N));
  }
}

/// Where incompressible, the equations of what is left are solved until the divergence is small.
template <int D>
void FlowInverse<D>::solve_mixed(std::int64_t cases, double eta, const FlowResidual& residual,
                                 const Forced& forced, double* v, double* p, FlowStats* stats,
                                 ThreadPool& pool) {
  const std::int64_t N = grid().num_nodes * D, M = grid().num_cells;
  const bool strict = options().incompressible;
  std::vector<double> r(u(N)), C(u(M)), step(u(N)), pressure(u(M));
  for (std::int64_t k = 0; k < cases; ++k) {
    FlowStats& s = stats[k];
    double rtol = options().rtol;
    for (int round = 0;; ++round) {
      take_excess(residual, k, forced, eta, p + k * M, C.data());
      residual.momentum(k, round ? p + k * M : nullptr, r.data());
      for (double& value : r) value /= -eta;
      for (double& value : C) value = -value;
      const KrylovResult result =
          mixed_->solve(r.data(), C.data(), step.data(), pressure.data(), rtol,
                        options().max_iters - static_cast<int>(s.num_iters), pool);
      s.num_iters += result.num_iters;
      s.residual = result.residual_norm * (round ? s.residual : 1.0);
      for (std::int64_t i = 0; i < N; ++i) v[k * N + i] += step[u(i)];
      for (std::int64_t cell = 0; cell < M; ++cell) p[k * M + cell] += eta * pressure[u(cell)];
      take_excess(residual, k, forced, eta, p + k * M, C.data());
      s.divergence = space_.divergence(C.data(), space_.speed(v + k * N));
      s.converged = strict ? s.residual <= options().rtol && s.divergence <= options().tolerance
                           : result.converged;
      if (!strict || s.converged != 0.0 || s.num_iters >= options().max_iters || !result.converged)
        break;
      rtol = std::max(1e-6, std::min(0.1, 0.3 * options().tolerance / s.divergence));
    }
  }
}

template class FlowInverse<2>;
template class FlowInverse<3>;

}  // namespace diffsim
