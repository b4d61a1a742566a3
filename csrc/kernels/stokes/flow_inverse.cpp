#include "kernels/stokes/flow_inverse.h"

#include <chrono>

namespace diffsim {
namespace {

std::size_t u(std::int64_t i) { return static_cast<std::size_t>(i); }

double seconds() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

/// Where the iterative path begins to be the faster one, by measurement: in two dimensions beyond
/// what fits into memory. In three the factor's iteration to div v = 0 ends early in the pressures
/// of cells that a wall enters through a corner: with tolerances of 1e-8 gradients are off by 5 %.
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
    const std::vector<double> values = matrix.assemble(space_.fixed(), options().bulk, pool);
    report_.assembly_s = seconds() - analysis_end;
    try {
      factor_->refactor(values.data(), pool);
    } catch (const NotPositiveDefinite& e) {
      const std::int64_t node = space_.geometry().active_nodes()[u(e.unknown / D)];
      throw NotPositiveDefinite(node * D + e.unknown % D, e.pivot);
    }
  }
  report_.factor_s = seconds() - analysis_end - report_.assembly_s;
  report_.analysis_s = analysis_end - start;
  report_.factor_nnz = factor_->nnz();
  report_.solver_bytes = report_.factor_bytes = factor_->bytes();
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
void FlowInverse<D>::add_compliance(double eta, const double* p, double* C) const {
  const ClosedRegions<D>& closed = space_.closed();
  const auto sum = closed.sums([&](const auto& c) { return c.volume * p[c.cell]; });
  for (const auto& c : closed.cells())
    C[c.cell] += c.volume * sum[u(c.region)] / (options().bulk * eta * closed.weight(c.region));
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
    for (std::int64_t k = 0; k < cases; ++k) stats[k] = {0.0, 0.0, 1.0, stats[k].net_inflow, 0.0};
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

template <int D>
void FlowInverse<D>::solve_direct(std::int64_t cases, double eta, const FlowResidual& residual,
                                  const Forced& forced, double* v, double* p, FlowStats* stats,
                                  ThreadPool& pool) {
  const std::int64_t N = grid().num_nodes * D, M = grid().num_cells;
  const bool strict = options().incompressible;
  start_direct(cases, eta, residual, forced, v, p, pool);
  std::vector<double> C(u(M)), remainder(strict ? u(M * cases) : 0);
  for (std::int64_t k = 0; k < cases; ++k) {
    take_mass(residual, k, forced, C.data());
    if (strict) space_.closed().subtract(space_.closed().means(C.data()), C.data());
    stats[k].num_iters = 1.0;
    stats[k].divergence = space_.divergence(C.data(), v + k * N);
    for (std::int64_t cell = 0; cell < M && strict; ++cell)
      remainder[u(k * M + cell)] = -C[u(cell)];
  }
  if (strict) close(eta, cases, v, p, remainder.data(), stats, pool);
  for (std::int64_t k = 0; k < cases; ++k) {
    take_mass(residual, k, forced, C.data());
    space_.add_pressure(-options().bulk * eta, C.data(), p + k * M);
  }
}

/// K v = b with the pressure eliminated, -(bulk / M) C(v, g): one correction of the lifted values.
template <int D>
void FlowInverse<D>::start_direct(std::int64_t cases, double eta, const FlowResidual& residual,
                                  const Forced& forced, double* v, double* p, ThreadPool& pool) {
  const std::int64_t N = grid().num_nodes * D, M = grid().num_cells;
  std::vector<double> r(u(N)), C(u(M)), b(space_.num_unknowns() * u(cases));
  for (std::int64_t k = 0; k < cases; ++k) {
    take_mass(residual, k, forced, C.data());
    space_.add_pressure(-options().bulk * eta, C.data(), p + k * M);
    residual.momentum(k, p + k * M, r.data());
    space_.gather(r.data(), b.data(), k, cases, -1.0 / eta);
    std::fill(p + k * M, p + (k + 1) * M, 0.0);
  }
  factor_->solve(b.data(), b.data(), static_cast<int>(cases), workspace_, pool);
  for (std::int64_t k = 0; k < cases; ++k) space_.scatter_add(b.data(), k, cases, 1.0, v + k * N);
}

/// Where incompressible, the equations of what is left are solved until the divergence is small.
template <int D>
void FlowInverse<D>::solve_mixed(std::int64_t cases, double eta, const FlowResidual& residual,
                                 const Forced& forced, double* v, double* p, FlowStats* stats,
                                 ThreadPool& pool) {
  const std::int64_t N = grid().num_nodes * D, M = grid().num_cells;
  const bool strict = options().incompressible;
  std::vector<double> r(u(N)), C(u(M)), step(u(N)), pressure(u(M));
  const auto take_excess = [&](std::int64_t k) {
    take_mass(residual, k, forced, C.data());
    if (strict) add_compliance(eta, p + k * M, C.data());
  };
  for (std::int64_t k = 0; k < cases; ++k) {
    FlowStats& s = stats[k];
    double rtol = options().rtol;
    for (int round = 0;; ++round) {
      take_excess(k);
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
      take_excess(k);
      s.divergence = space_.divergence(C.data(), v + k * N);
      s.converged = strict ? s.residual <= options().rtol && s.divergence <= options().tolerance
                           : result.converged;
      if (!strict || s.converged != 0.0 || s.num_iters >= options().max_iters || !result.converged)
        break;
      rtol = std::max(1e-6, std::min(0.1, 0.3 * options().tolerance / s.divergence));
    }
  }
}

/// Drives C of each case to zero: conjugate gradients for C K^-1 C' d = remainder, preconditioned
/// by bulk / M, of which the eigenvalues are s / (1 + s) with s about bulk / viscosity: next to
/// one, but for a few.
/// @param remainder (cases, num_cells), updated
template <int D>
void FlowInverse<D>::close(double eta, std::int64_t cases, double* v, double* p, double* remainder,
                           FlowStats* stats, ThreadPool& pool) {
  const std::int64_t N = grid().num_nodes * D, M = grid().num_cells;
  const double bulk = options().bulk * eta;
  std::vector<double> d(u(M * cases), 0.0), y(u(M)), rest(u(N), 0.0), r(u(N)), C(u(M));
  std::vector<double> b(space_.num_unknowns() * u(cases)), ry(u(cases), 0.0), step(u(N));
  const auto dot = [&](const double* a, const double* c) {
    double sum = 0.0;
    for (std::int64_t cell = 0; cell < M; ++cell) sum += a[cell] * c[cell];
    return sum;
  };
  for (int iter = 1;; ++iter) {
    bool done = true;
    for (std::int64_t k = 0; k < cases; ++k) {
      const double* rk = remainder + k * M;
      stats[k].divergence = space_.divergence(rk, v + k * N);
      stats[k].converged = stats[k].divergence <= options().tolerance;
      done = done && stats[k].converged != 0.0;
      std::fill(y.begin(), y.end(), 0.0);
      space_.add_pressure(bulk, rk, y.data());
      space_.closed().subtract_level(y.data());
      const double now = dot(rk, y.data()), beta = ry[u(k)] > 0.0 ? now / ry[u(k)] : 0.0;
      ry[u(k)] = now;
      for (std::int64_t cell = 0; cell < M; ++cell)
        d[u(k * M + cell)] = y[u(cell)] + beta * d[u(k * M + cell)];
    }
    if (done || iter >= options().max_iters) return;
    for (std::int64_t k = 0; k < cases; ++k) {
      op().residual(rest.data(), FlowData(), d.data() + k * M, eta, r.data(), pool);
      space_.gather(r.data(), b.data(), k, cases, -1.0 / eta);
    }
    factor_->solve(b.data(), b.data(), static_cast<int>(cases), workspace_, pool);
    for (std::int64_t k = 0; k < cases; ++k) {
      std::fill(step.begin(), step.end(), 0.0);
      space_.scatter_add(b.data(), k, cases, 1.0, step.data());
      op().outflow(step.data(), nullptr, C.data(), pool);
      space_.skip_rigid(C.data());
      space_.closed().subtract(space_.closed().means(C.data()), C.data());
      const double curvature = dot(d.data() + k * M, C.data());
      if (!(curvature > 0.0)) continue;
      const double alpha = ry[u(k)] / curvature;
      for (std::int64_t cell = 0; cell < M; ++cell) {
        p[k * M + cell] += alpha * d[u(k * M + cell)];
        remainder[k * M + cell] -= alpha * C[u(cell)];
      }
      for (std::int64_t i = 0; i < N; ++i) v[k * N + i] += alpha * step[u(i)];
      stats[k].num_iters = iter + 1;
    }
  }
}

template class FlowInverse<2>;
template class FlowInverse<3>;

}  // namespace diffsim
