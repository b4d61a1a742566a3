#include "kernels/stokes/flow_system.h"

#include <chrono>

#include "kernels/stokes/flow_mixed.h"
#include "kernels/stokes/flow_space.h"

namespace diffsim {
namespace {

std::size_t u(std::int64_t i) { return static_cast<std::size_t>(i); }

double seconds() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

const double* at_case(const double* field, std::int64_t stride, std::int64_t k) {
  return field ? field + stride * k : nullptr;
}
double* at_case(double* field, std::int64_t stride, std::int64_t k) {
  return field ? field + stride * k : nullptr;
}

/// Where the iterative path begins to be the faster one, by measurement: in two dimensions, and
/// where incompressible (a solve per step of the pressure's iteration), beyond what fits into
/// memory.
template <int D>
bool choose_iterative(const FlowOptions& options, std::int64_t num_nodes) {
  if (options.solver != FlowSolver::kAuto) return options.solver == FlowSolver::kIterative;
  return D == 3 && !options.incompressible && num_nodes > kMaxDirectNodes;
}

template <int D>
class FlowSystem final : public StokesSystem {
 public:
  FlowSystem(const FlowGeometryInputs& in, const FlowOptions& options, StokesPlan& plan,
             ThreadPool& pool)
      : start_(seconds()), space_(in, options, pool), memory_(plan.memory()) {
    const FlowMatrix<D> matrix(op(), pool);
    report_.geometry_s = seconds() - start_;
    report_.num_cells = geometry().num_active_cells();
    for (std::int64_t cell : geometry().cut_cells())
      report_.num_cut_cells += geometry().active(cell);
    report_.num_nodes = matrix.num_nodes();
    report_.iterative = choose_iterative<D>(options, matrix.num_nodes());
    if (report_.iterative)
      prepare_iterative(in, matrix, pool);
    else
      factorize(in, matrix, plan, pool);
    space_.regions().count(report_.num_regions, report_.num_loose_regions, report_.num_loose_cells);
  }

  ~FlowSystem() override {
    if (factor_) memory_->give_back(factor_->take_memory());
  }

  const FlowReport& report() const override { return report_; }
  const double* fractions() const override { return geometry().fractions().data(); }

  void solve(const FlowInputs& in, double* v, double* p, FlowStats* stats,
             ThreadPool& pool) override {
    const std::int64_t N = grid().num_nodes * D, M = grid().num_cells, cases = in.num_cases;
    std::fill(v, v + cases * N, 0.0);
    std::fill(p, p + cases * M, 0.0);
    for (std::int64_t k = 0; k < cases; ++k) {
      stats[k] = FlowStats();
      space_.for_active([&](std::int64_t i, std::int64_t) {
        if (space_.fixed(i)) v[k * N + i] = in.prescribed[k * N + i];
      });
      stats[k].net_inflow =
          space_.regions().net_inflow(op(), v + k * N, data_of(in, k).wall_velocity);
    }
    if (mixed_) return solve_mixed(in, v, p, stats, pool);
    // K v = b with the pressure eliminated, -(bulk / M) C(v, g): one correction of the lifted
    // values.
    const double bulk = options().bulk * in.viscosity;
    std::vector<double> r(u(N)), C(u(M)), b(space_.num_unknowns() * u(cases)),
        remainder(u(M * cases));
    const auto excess = [&](std::int64_t k) {
      op().outflow(v + k * N, data_of(in, k).wall_velocity, C.data(), pool);
      if (options().incompressible) space_.constrain(C.data(), nullptr);
    };
    for (std::int64_t k = 0; k < cases; ++k) {
      excess(k);
      space_.add_pressure(-bulk, C.data(), p + k * M);
      op().residual(v + k * N, data_of(in, k), p + k * M, in.viscosity, r.data(), pool);
      space_.gather(r.data(), b.data(), k, cases, -1.0 / in.viscosity);
      std::fill(p + k * M, p + (k + 1) * M, 0.0);
    }
    factor_->solve(b.data(), b.data(), static_cast<int>(cases), workspace_, pool);
    for (std::int64_t k = 0; k < cases; ++k) {
      space_.scatter_add(b.data(), k, cases, 1.0, v + k * N);
      excess(k);
      stats[k].num_iters = 1.0;
      stats[k].divergence = space_.divergence(C.data(), v + k * N);
      for (std::int64_t cell = 0; cell < M; ++cell) remainder[u(k * M + cell)] = -C[u(cell)];
    }
    if (options().incompressible)
      close(in.viscosity, cases, 1.0, v, p, remainder.data(), stats, pool);
    for (std::int64_t k = 0; k < cases; ++k) {
      space_.add_pressure(bulk, remainder.data() + k * M, p + k * M);
      if (options().incompressible) space_.subtract_level(p + k * M);
    }
  }

  void adjoint(const FlowInputs& in, const double* v, const double* p, const double* grad_v,
               const double* grad_p, const double* grad_fraction, const FlowGradients& grad,
               FlowStats* stats, ThreadPool& pool) override {
    const std::int64_t N = grid().num_nodes * D, M = grid().num_cells, cases = in.num_cases;
    const double bulk = options().bulk * in.viscosity;
    const bool strict = options().incompressible;
    std::vector<double> z(u(N * cases)), pi(u(M * cases)), mu(u(M * cases)), mean(u(M));
    std::vector<double> r(u(N)), C(u(M)), effective(u(M));
    for (std::int64_t k = 0; k < cases; ++k) stats[k] = FlowStats();
    // Stationary points of L(v, p) - e(v, z) + p C(z) - pi (C(v, g) - mean V + p M / bulk) - mu p
    // V:
    //   e(., z) + C' pi = dL/dv,  C z + dL/dp = pi M / bulk  (or mu V where incompressible).
    if (mixed_)
      adjoint_mixed(in, grad_v, grad_p, z.data(), pi.data(), mu.data(), stats, pool);
    else
      adjoint_direct(in, grad_v, grad_p, z.data(), pi.data(), mu.data(), stats, pool);

    const double inverse_bulk = strict ? 0.0 : 1.0 / bulk;
    for (std::int64_t k = 0; k < cases; ++k) {
      const FlowData data = data_of(in, k);
      double* zk = z.data() + k * N;
      const double* pk = pi.data() + k * M;
      if (strict) {  // the dilatation that the boundary values force on closed regions
        op().outflow(v + k * N, data.wall_velocity, C.data(), pool);
        space_.constrain(C.data(), mean.data());
      }
      const FlowDataGradient out = {at_case(grad.data.wall_velocity, in.wall_stride, k),
                                    at_case(grad.data.body_force, in.force_stride, k),
                                    at_case(grad.data.traction, in.traction_stride, k)};
      // the gradient is that of -[...]: see flow_operator.h
      op().gradient(v + k * N, zk, data, p + k * M, pk, inverse_bulk,
                    strict ? mean.data() : nullptr, strict ? mu.data() + k * M : nullptr,
                    in.viscosity, grad.phi, out, pool);
      // Prescribed values: dL/dv - e(., z) - C' pi at their components.
      for (std::int64_t cell = 0; cell < M; ++cell) effective[u(cell)] = -pk[cell];
      op().residual(zk, FlowData(), effective.data(), in.viscosity, r.data(), pool);
      double* prescribed = grad.prescribed + k * N;
      std::fill(prescribed, prescribed + N, 0.0);
      space_.for_active([&](std::int64_t i, std::int64_t) {
        if (space_.fixed(i)) prescribed[i] = grad_v[k * N + i] - r[u(i)];
      });
      // Viscosity: everything viscous in e is proportional to it, and so is the bulk modulus.
      op().residual(v + k * N, {data.wall_velocity, nullptr, nullptr}, nullptr, 1.0, r.data(),
                    pool);
      double sum = 0.0;
      space_.for_active([&](std::int64_t i, std::int64_t) { sum += r[u(i)] * zk[i]; });
      for (std::int64_t cell = 0; cell < M && !strict; ++cell)
        if (geometry().active(cell))
          sum -=
              pk[cell] * p[k * M + cell] * op().pressure_volume(cell) * inverse_bulk / in.viscosity;
      *grad.viscosity -= sum;
    }
    op().fraction_gradient(grad_fraction, grad.phi);
  }

 private:
  const FlowOperator<D>& op() const { return space_.op(); }
  const FlowOptions& options() const { return space_.options(); }
  const FlowGeometry<D>& geometry() const { return space_.geometry(); }
  const StokesGrid<D>& grid() const { return space_.grid(); }
  static FlowData data_of(const FlowInputs& in, std::int64_t k) {
    return {at_case(in.data.wall_velocity, in.wall_stride, k),
            at_case(in.data.body_force, in.force_stride, k),
            at_case(in.data.traction, in.traction_stride, k)};
  }

  void factorize(const FlowGeometryInputs& in, const FlowMatrix<D>& matrix, StokesPlan& plan,
                 ThreadPool& pool) {
    const double start = seconds();
    factor_ = std::make_unique<CholeskyFactor>(matrix.analyze(in.fixed, plan),
                                               FactorPrecision::kFloat64, memory_->take());
    const double analysis_end = seconds();
    {
      const std::vector<double> values = matrix.assemble(in.fixed, options().bulk, pool);
      report_.assembly_s = seconds() - analysis_end;
      try {
        factor_->refactor(values.data(), pool);
      } catch (const NotPositiveDefinite& e) {
        const std::int64_t node = geometry().active_nodes()[u(e.unknown / D)];
        throw NotPositiveDefinite(node * D + e.unknown % D, e.pivot);
      }
    }
    report_.factor_s = seconds() - analysis_end - report_.assembly_s;
    report_.analysis_s = analysis_end - start;
    report_.factor_nnz = factor_->nnz();
    report_.solver_bytes = report_.factor_bytes = factor_->bytes();
    report_.factor_flops = factor_->flops();
  }
  void prepare_iterative(const FlowGeometryInputs& in, const FlowMatrix<D>& matrix,
                         ThreadPool& pool) {
    const double start = seconds();
    try {
      mixed_ = std::make_unique<FlowMixed<D>>(op(), matrix, in.fixed, pool);
    } catch (const NotPositiveDefinite& e) {
      throw NotPositiveDefinite(-1, e.pivot);  // an unknown of a coarse grid means nothing outside
    }
    report_.assembly_s = seconds() - start;
    report_.solver_bytes = mixed_->bytes();
  }

  /// The mixed system from the lifted values in v.
  void solve_mixed(const FlowInputs& in, double* v, double* p, FlowStats* stats, ThreadPool& pool) {
    const std::int64_t N = grid().num_nodes * D, M = grid().num_cells;
    const bool strict = options().incompressible;
    std::vector<double> r(u(N)), C(u(M)), step(u(N)), pressure(u(M));
    std::vector<double> remainder(strict ? u(M * in.num_cases) : 0);
    const auto excess = [&](std::int64_t k) {
      op().outflow(v + k * N, data_of(in, k).wall_velocity, C.data(), pool);
      if (strict) space_.constrain(C.data(), nullptr);
    };
    for (std::int64_t k = 0; k < in.num_cases; ++k) {
      excess(k);
      op().residual(v + k * N, data_of(in, k), nullptr, in.viscosity, r.data(), pool);
      for (double& value : r) value /= -in.viscosity;
      for (double& value : C) value = -value;
      run_mixed(r.data(), C.data(), step.data(), pressure.data(), stats[k], pool);
      for (std::int64_t i = 0; i < N; ++i) v[k * N + i] += step[u(i)];
      for (std::int64_t cell = 0; cell < M; ++cell)
        p[k * M + cell] = in.viscosity * pressure[u(cell)];
      excess(k);
      stats[k].divergence = space_.divergence(C.data(), v + k * N);
      for (std::int64_t cell = 0; cell < M && strict; ++cell)
        remainder[u(k * M + cell)] = -C[u(cell)];
    }
    if (!strict) return;
    close(in.viscosity, in.num_cases, 1.0, v, p, remainder.data(), stats, pool);
    for (std::int64_t k = 0; k < in.num_cases; ++k) space_.subtract_level(p + k * M);
  }
  /// E z - C' p = dL/dv / eta, C z + p M / bulk = -dL/dp, pi = -eta p.
  void adjoint_mixed(const FlowInputs& in, const double* grad_v, const double* grad_p, double* z,
                     double* pi, double* mu, FlowStats* stats, ThreadPool& pool) {
    const std::int64_t N = grid().num_nodes * D, M = grid().num_cells;
    const bool strict = options().incompressible;
    std::vector<double> f(u(N)), C(u(M)), remainder(strict ? u(M * in.num_cases) : 0);
    for (std::int64_t k = 0; k < in.num_cases; ++k) {
      for (std::int64_t i = 0; i < N; ++i) f[u(i)] = grad_v[k * N + i] / in.viscosity;
      adjoint_excess(k, z, grad_p, mu, C.data(), pool);
      for (double& value : C) value = -value;
      run_mixed(f.data(), C.data(), z + k * N, pi + k * M, stats[k], pool);
      for (std::int64_t cell = 0; cell < M; ++cell) pi[k * M + cell] *= -in.viscosity;
      adjoint_excess(k, z, grad_p, mu, C.data(), pool);
      stats[k].divergence = space_.divergence(C.data(), z + k * N);
      if (strict) std::copy(C.begin(), C.end(), remainder.begin() + k * M);
    }
    if (!strict) return;
    close(in.viscosity, in.num_cases, -1.0, z, pi, remainder.data(), stats, pool);
    for (std::int64_t k = 0; k < in.num_cases; ++k) {
      adjoint_excess(k, z, grad_p, mu, C.data(), pool);  // mu of the final z
      space_.subtract_level(pi + k * M);
    }
  }
  void run_mixed(const double* f, const double* g, double* v, double* p, FlowStats& stats,
                 ThreadPool& pool) {
    const FlowOptions& options = space_.options();
    const KrylovResult result = mixed_->solve(f, g, v, p, options.rtol, options.max_iters, pool);
    stats.num_iters = result.num_iters;
    stats.residual = result.residual_norm;
    stats.converged = result.converged;
  }

  /// C z + dL/dp - mu V of a case.
  void adjoint_excess(std::int64_t k, const double* z, const double* grad_p, double* mu, double* C,
                      ThreadPool& pool) const {
    const std::int64_t N = grid().num_nodes * D, M = grid().num_cells;
    op().outflow(z + k * N, nullptr, C, pool);
    for (std::int64_t cell = 0; cell < M; ++cell)
      if (geometry().active(cell)) C[cell] += grad_p[k * M + cell];
    if (options().incompressible) space_.constrain(C, mu + k * M);
  }
  /// @param[out] z, pi, mu zero on entry
  void adjoint_direct(const FlowInputs& in, const double* grad_v, const double* grad_p, double* z,
                      double* pi, double* mu, FlowStats* stats, ThreadPool& pool) {
    const std::int64_t N = grid().num_nodes * D, M = grid().num_cells, cases = in.num_cases;
    const double bulk = options().bulk * in.viscosity;
    const bool strict = options().incompressible;
    std::vector<double> r(u(N)), C(u(M)), effective(u(M)), b(space_.num_unknowns() * u(cases));
    const auto excess = [&](std::int64_t k) { adjoint_excess(k, z, grad_p, mu, C.data(), pool); };
    for (std::int64_t k = 0; k < cases; ++k) {
      excess(k);
      std::fill(effective.begin(), effective.end(), 0.0);
      space_.add_pressure(-bulk, C.data(), effective.data());
      op().residual(z + k * N, FlowData(), effective.data(), in.viscosity, r.data(), pool);
      space_.for_active([&](std::int64_t i, std::int64_t) { r[u(i)] -= grad_v[k * N + i]; });
      space_.gather(r.data(), b.data(), k, cases, -1.0 / in.viscosity);
    }
    factor_->solve(b.data(), b.data(), static_cast<int>(cases), workspace_, pool);
    std::vector<double> remainder(u(M * cases));
    for (std::int64_t k = 0; k < cases; ++k) {
      space_.scatter_add(b.data(), k, cases, 1.0, z + k * N);
      excess(k);
      stats[k].num_iters = 1.0;
      stats[k].divergence = space_.divergence(C.data(), z + k * N);
      std::copy(C.begin(), C.end(), remainder.begin() + k * M);
    }
    if (strict) {
      close(in.viscosity, cases, -1.0, z, pi, remainder.data(), stats, pool);
      for (std::int64_t k = 0; k < cases; ++k) excess(k);  // mu of the final z
    }
    for (std::int64_t k = 0; k < cases; ++k) {
      space_.add_pressure(bulk, remainder.data() + k * M, pi + k * M);
      if (strict) space_.subtract_level(pi + k * M);
    }
  }

  /// Drives C of each case to zero: conjugate gradients for C K^-1 C' d = remainder, preconditioned
  /// by bulk / M, of which the eigenvalues are s / (1 + s) with s about bulk / viscosity: next to
  /// one, but for a few.
  /// @param sign      of the step K^-1 C' d in x
  /// @param remainder (cases, num_cells), updated
  void close(double eta, std::int64_t cases, double sign, double* x, double* multiplier,
             double* remainder, FlowStats* stats, ThreadPool& pool) {
    const FlowOptions& options = space_.options();
    const std::int64_t N = grid().num_nodes * D, M = grid().num_cells;
    const double bulk = options.bulk * eta;
    std::vector<double> d(u(M * cases), 0.0), y(u(M)), rest(u(N), 0.0), r(u(N)), C(u(M));
    std::vector<double> b(space_.num_unknowns() * u(cases)), ry(u(cases), 0.0), step(u(N));
    std::vector<double> inner_iters(u(cases));
    for (std::int64_t k = 0; k < cases; ++k) inner_iters[u(k)] = stats[k].num_iters;
    const auto dot = [&](const double* a, const double* c) {
      double sum = 0.0;
      for (std::int64_t cell = 0; cell < M; ++cell) sum += a[cell] * c[cell];
      return sum;
    };
    for (int iter = 1;; ++iter) {
      bool done = true;
      for (std::int64_t k = 0; k < cases; ++k) {
        const double* rk = remainder + k * M;
        stats[k].divergence = space_.divergence(rk, x + k * N);
        stats[k].converged = stats[k].divergence <= options.tolerance;
        done = done && stats[k].converged != 0.0;
        std::fill(y.begin(), y.end(), 0.0);
        space_.add_pressure(bulk, rk, y.data());
        space_.subtract_level(y.data());
        for (std::int64_t cell : space_.rigid_cells()) y[u(cell)] = 0.0;
        const double now = dot(rk, y.data()), beta = ry[u(k)] > 0.0 ? now / ry[u(k)] : 0.0;
        ry[u(k)] = now;
        for (std::int64_t cell = 0; cell < M; ++cell)
          d[u(k * M + cell)] = y[u(cell)] + beta * d[u(k * M + cell)];
      }
      if (done || iter >= options.max_iters) return;
      for (std::int64_t k = 0; k < cases && factor_; ++k) {
        op().residual(rest.data(), FlowData(), d.data() + k * M, eta, r.data(), pool);
        space_.gather(r.data(), b.data(), k, cases, -1.0 / eta);
      }
      if (factor_) factor_->solve(b.data(), b.data(), static_cast<int>(cases), workspace_, pool);
      for (std::int64_t k = 0; k < cases; ++k) {
        std::fill(step.begin(), step.end(), 0.0);
        if (factor_) {
          space_.scatter_add(b.data(), k, cases, 1.0, step.data());
        } else {  // K v = C' d / eta as E v - C' p = 0, C v + p M / bulk = d M / (bulk eta)
          for (std::int64_t cell = 0; cell < M; ++cell)
            C[u(cell)] = d[u(k * M + cell)] / bulk * op().pressure_volume(cell);
          const KrylovResult inner = mixed_->solve(rest.data(), C.data(), step.data(), y.data(),
                                                   options.rtol, options.max_iters, pool);
          inner_iters[u(k)] += inner.num_iters;
        }
        op().outflow(step.data(), nullptr, C.data(), pool);
        space_.constrain(C.data(), nullptr);
        const double curvature = dot(d.data() + k * M, C.data());
        if (!(curvature > 0.0)) continue;
        const double alpha = ry[u(k)] / curvature;
        for (std::int64_t cell = 0; cell < M; ++cell) {
          multiplier[k * M + cell] += alpha * (factor_ ? d[u(k * M + cell)] : eta * y[u(cell)]);
          remainder[k * M + cell] -= alpha * C[u(cell)];
        }
        for (std::int64_t i = 0; i < N; ++i) x[k * N + i] += sign * alpha * step[u(i)];
        stats[k].num_iters = factor_ ? iter + 1 : inner_iters[u(k)];
      }
    }
  }

  double start_;
  FlowSpace<D> space_;
  std::shared_ptr<StokesMemory> memory_;
  std::unique_ptr<CholeskyFactor> factor_;  // or
  std::unique_ptr<FlowMixed<D>> mixed_;
  CholeskyWorkspace workspace_;
  FlowReport report_;
};

}  // namespace

std::shared_ptr<StokesSystem> make_stokes_system(const FlowGeometryInputs& in,
                                                 const FlowOptions& options, StokesPlan& plan,
                                                 ThreadPool& pool) {
  if (in.shape.dim == 2) return std::make_shared<FlowSystem<2>>(in, options, plan, pool);
  return std::make_shared<FlowSystem<3>>(in, options, plan, pool);
}

}  // namespace diffsim
