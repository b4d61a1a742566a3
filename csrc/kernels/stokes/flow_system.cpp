#include "kernels/stokes/flow_system.h"

#include "kernels/seconds.h"
#include "kernels/stokes/flow_inverse.h"
#include "kernels/stokes/flow_tangent.h"
#include "kernels/subscript.h"

namespace diffsim {
namespace {

const double* at_case(const double* field, std::int64_t stride, std::int64_t k) {
  return field ? field + stride * k : nullptr;
}
double* at_case(double* field, std::int64_t stride, std::int64_t k) {
  return field ? field + stride * k : nullptr;
}

template <int D>
class FlowSystem final : public StokesSystem {
 public:
  FlowSystem(const FlowGeometryInputs& in, const FlowOptions& options, StokesPlan& plan,
             ThreadPool& pool)
      : start_(seconds()),
        space_(in, options, pool),
        inverse_(space_, plan, pool, report_, start_) {
    report_.num_cells = geometry().num_active_cells();
    for (std::int64_t cell : geometry().cut_cells())
      report_.num_cut_cells += geometry().active(cell);
    space_.regions().count(report_.num_regions, report_.num_loose_regions, report_.num_loose_cells);
  }

  const FlowReport& report() const override { return report_; }
  const double* fractions() const override { return geometry().fractions().data(); }

  void solve(const FlowInputs& in, double* v, double* p, FlowStats* stats,
             ThreadPool& pool) override {
    const std::int64_t N = grid().num_nodes * D, M = grid().num_cells, cases = in.num_cases;
    lift(in.prescribed, cases, v);
    std::fill(p, p + cases * M, 0.0);
    for (std::int64_t k = 0; k < cases; ++k) {
      stats[k] = FlowStats();
      stats[k].net_inflow =
          space_.regions().net_inflow(op(), v + k * N, data_of(in, k).wall_velocity);
    }
    const FlowResidual residual = {[&](std::int64_t k, const double* pressure, double* r) {
                                     op().residual(v + k * N, data_of(in, k), pressure,
                                                   in.viscosity, r, pool);
                                   },
                                   [&](std::int64_t k, double* C) {
                                     op().outflow(v + k * N, data_of(in, k).wall_velocity, C, pool);
                                   }};
    inverse_.solve(cases, in.viscosity, residual, forced_of(in, v, pool), v, p, stats, pool);
    for (std::int64_t k = 0; k < cases && options().incompressible; ++k)
      closed().subtract_level(p + k * M);
  }

  void equations(const FlowInputs& in, const double* v, const double* p, double* momentum,
                 double* mass, ThreadPool& pool) const override {
    op().residual(v, in.data, p, in.viscosity, momentum, pool);
    op().outflow(v, in.data.wall_velocity, mass, pool);
  }

  void tangent(const FlowInputs& in, const double* v, const double* p, const FlowDirections& along,
               double* d_v, double* d_p, double* d_fraction, FlowStats* stats,
               ThreadPool& pool) override {
    const std::int64_t N = grid().num_nodes * D, M = grid().num_cells, cases = in.num_cases;
    const FlowTangent<D> geometry_rate(op(), along.phi);
    std::copy(geometry_rate.fractions().begin(), geometry_rate.fractions().end(), d_fraction);
    const Forced forced = forced_of(in, v, pool);
    lift(along.prescribed, cases, d_v);
    std::fill(d_p, d_p + cases * M, 0.0);
    // Rates of both equations with d_v and d_p held at zero.
    std::vector<double> r(u(N * cases), 0.0), q(u(M * cases), 0.0), momentum(u(M));
    for (std::int64_t k = 0; k < cases; ++k) {
      const FlowData data = data_of(in, k), rate = data_at(along.data, in, k);
      const double* vk = v + k * N;
      full_pressure(in, k, vk, p + k * M, forced, momentum.data(), pool);
      geometry_rate.add_momentum(vk, data, momentum.data(), in.viscosity, r.data() + k * N, pool);
      geometry_rate.add_mass(vk, data.wall_velocity, q.data() + k * M, pool);
      if (options().incompressible)
        add_closed_rate(in, k, vk, d_v + k * N, rate.wall_velocity, momentum.data(), forced[u(k)],
                        geometry_rate, along.viscosity, q.data() + k * M, pool);
      else
        add_bulk_rate(in, momentum.data(), geometry_rate, along.viscosity, q.data() + k * M);
      if (along.viscosity == 0.0) continue;
      std::vector<double> viscous(u(N));  // everything viscous in e is proportional to it
      op().residual(vk, {data.wall_velocity, nullptr, nullptr}, nullptr, along.viscosity,
                    viscous.data(), pool);
      for (std::int64_t i = 0; i < N; ++i) r[u(k * N + i)] += viscous[u(i)];
    }
    const FlowResidual residual = {
        [&](std::int64_t k, const double* pressure, double* out) {
          op().residual(d_v + k * N, data_at(along.data, in, k), pressure, in.viscosity, out, pool);
          for (std::int64_t i = 0; i < N; ++i) out[i] += r[u(k * N + i)];
        },
        [&](std::int64_t k, double* out) {
          op().outflow(d_v + k * N, data_at(along.data, in, k).wall_velocity, out, pool);
          for (std::int64_t cell = 0; cell < M; ++cell) out[cell] += q[u(k * M + cell)];
        }};
    for (std::int64_t k = 0; k < cases; ++k) stats[k] = FlowStats();
    inverse_.solve(cases, in.viscosity, residual, unforced(cases), d_v, d_p, stats, pool);
    for (std::int64_t k = 0; k < cases && options().incompressible; ++k) {
      const Sums moved = closed().sums(
          [&](const Cell& c) { return geometry_rate.fluid_volume(c.cell) * p[k * M + c.cell]; });
      closed().subtract_level(d_p + k * M, &moved);  // sum V p = 0 moves with V
    }
  }

  void adjoint(const FlowInputs& in, const double* v, const double* p, const double* grad_v,
               const double* grad_p, const double* grad_fraction, const FlowGradients& grad,
               FlowStats* stats, ThreadPool& pool) override {
    const std::int64_t N = grid().num_nodes * D, M = grid().num_cells, cases = in.num_cases;
    const bool strict = options().incompressible;
    std::vector<double> z(u(N * cases)), pi(u(M * cases)), r(u(N));
    for (std::int64_t k = 0; k < cases; ++k) stats[k] = FlowStats();
    // Stationary points of L(v, p) - e(v, z) + p C(z) - pi (C(v, g) + p M / bulk), where
    // incompressible with the terms of closed_regions.h in place of the last. With pressures -pi
    // these are the equations of the flow.
    const FlowResidual residual = {
        [&](std::int64_t k, const double* pressure, double* out) {
          op().residual(z.data() + k * N, FlowData(), pressure, in.viscosity, out, pool);
          space_.for_active([&](std::int64_t i, std::int64_t) { out[i] -= grad_v[k * N + i]; });
        },
        [&](std::int64_t k, double* out) {
          op().outflow(z.data() + k * N, nullptr, out, pool);
          for (std::int64_t cell = 0; cell < M; ++cell)
            if (geometry().active(cell)) out[cell] += grad_p[k * M + cell];
        }};
    Forced given_means;  // of dL/dp: that of a pressure without level has none
    for (std::int64_t k = 0; k < cases; ++k) given_means.push_back(closed().means(grad_p + k * M));
    inverse_.solve(cases, in.viscosity, residual, given_means, z.data(), pi.data(), stats, pool);
    for (double& value : pi) value = -value;

    const Forced forced = forced_of(in, v, pool);
    std::vector<double> momentum(u(M)), lifted(strict ? u(N) : 0), by_lifted(u(M)), none(u(M), 0.0),
        rest(strict ? u(N) : 0, 0.0);
    for (std::int64_t k = 0; k < cases; ++k) {
      const FlowData data = data_of(in, k);
      const double *vk = v + k * N, *zk = z.data() + k * N, *pk = pi.data() + k * M;
      full_pressure(in, k, vk, p + k * M, forced, momentum.data(), pool);
      const FlowDataGradient out = {at_case(grad.data.wall_velocity, in.wall_stride, k),
                                    at_case(grad.data.body_force, in.force_stride, k),
                                    at_case(grad.data.traction, in.traction_stride, k)};
      std::vector<double> by_volume(u(M), 0.0), by_mass(u(M), 0.0);
      std::fill(by_lifted.begin(), by_lifted.end(), 0.0);
      double by_viscosity = 0.0;
      if (strict) {
        by_viscosity =
            closed_gradient(in.viscosity, momentum.data(), p + k * M, pk, forced[u(k)],
                            given_means[u(k)], by_volume.data(), by_mass.data(), by_lifted.data());
      } else {
        const double inverse_bulk = 1.0 / (options().bulk * in.viscosity);
        for (std::int64_t cell = 0; cell < M; ++cell) {
          by_mass[u(cell)] = pk[cell] * momentum[u(cell)] * inverse_bulk;
          by_viscosity -= by_mass[u(cell)] * op().pressure_volume(cell) / in.viscosity;
        }
      }
      op().gradient(vk, zk, data, momentum.data(), pk, by_volume.data(), by_mass.data(),
                    in.viscosity, grad.phi, out, pool);
      if (strict && !closed().cells().empty()) {  // the forced dilatation, C(lifted values, g)
        lift_case(vk, lifted.data());
        op().gradient(lifted.data(), rest.data(), {data.wall_velocity, nullptr, nullptr},
                      none.data(), by_lifted.data(), none.data(), none.data(), in.viscosity,
                      grad.phi, {out.wall_velocity, nullptr, nullptr}, pool);
      }
      // Prescribed values: dL/dv - e(., z) - C' pi at their components.
      for (std::int64_t cell = 0; cell < M; ++cell)
        momentum[u(cell)] = -pk[cell] - by_lifted[u(cell)];
      op().residual(zk, FlowData(), momentum.data(), in.viscosity, r.data(), pool);
      double* prescribed = grad.prescribed + k * N;
      std::fill(prescribed, prescribed + N, 0.0);
      space_.for_active([&](std::int64_t i, std::int64_t) {
        if (space_.fixed(i)) prescribed[i] = grad_v[k * N + i] - r[u(i)];
      });
      // Viscosity: everything viscous in e is proportional to it, and so is the bulk modulus.
      op().residual(vk, {data.wall_velocity, nullptr, nullptr}, nullptr, 1.0, r.data(), pool);
      space_.for_active([&](std::int64_t i, std::int64_t) { by_viscosity += r[u(i)] * zk[i]; });
      *grad.viscosity -= by_viscosity;
    }
    op().fraction_gradient(grad_fraction, grad.phi);
  }

 private:
  using Cell = typename ClosedRegions<D>::Cell;
  using Sums = typename ClosedRegions<D>::Sums;
  using Forced = typename FlowInverse<D>::Forced;

  const FlowOperator<D>& op() const { return space_.op(); }
  const ClosedRegions<D>& closed() const { return space_.closed(); }
  const FlowOptions& options() const { return space_.options(); }
  const FlowGeometry<D>& geometry() const { return space_.geometry(); }
  const StokesGrid<D>& grid() const { return space_.grid(); }
  static FlowData data_at(const FlowData& data, const FlowInputs& in, std::int64_t k) {
    return {at_case(data.wall_velocity, in.wall_stride, k),
            at_case(data.body_force, in.force_stride, k),
            at_case(data.traction, in.traction_stride, k)};
  }
  static FlowData data_of(const FlowInputs& in, std::int64_t k) { return data_at(in.data, in, k); }
  /// Prescribed values at prescribed components, zero elsewhere.
  void lift(const double* prescribed, std::int64_t cases, double* v) const {
    const std::int64_t N = grid().num_nodes * D;
    std::fill(v, v + cases * N, 0.0);
    for (std::int64_t k = 0; k < cases; ++k)
      space_.for_active([&](std::int64_t i, std::int64_t) {
        if (space_.fixed(i)) v[k * N + i] = prescribed[k * N + i];
      });
  }

  void lift_case(const double* v, double* lifted) const { lift(v, 1, lifted); }

  /// Dilatation f that the boundary values force on closed regions (closed_regions.h).
  Forced forced_of(const FlowInputs& in, const double* v, ThreadPool& pool) const {
    Forced forced(u(in.num_cases));
    if (!options().incompressible) return forced;
    const std::int64_t N = grid().num_nodes * D;
    std::vector<double> lifted(u(N)), C(u(grid().num_cells));
    for (std::int64_t k = 0; k < in.num_cases; ++k) {
      lift_case(v + k * N, lifted.data());
      op().outflow(lifted.data(), data_of(in, k).wall_velocity, C.data(), pool);
      forced[u(k)] = closed().means(C.data());
    }
    return forced;
  }
  Forced unforced(std::int64_t cases) const {
    return Forced(u(cases), closed().sums([](const Cell&) { return 0.0; }));
  }

  /// The momentum's pressure: p, and in closed regions its level.
  void full_pressure(const FlowInputs& in, std::int64_t k, const double* v, const double* p,
                     const Forced& forced, double* full, ThreadPool& pool) const {
    std::copy(p, p + grid().num_cells, full);
    if (!options().incompressible || closed().cells().empty()) return;
    std::vector<double> C(u(grid().num_cells));
    op().outflow(v, data_of(in, k).wall_velocity, C.data(), pool);
    closed().subtract(forced[u(k)], C.data());
    closed().add_level(options().bulk * in.viscosity, C.data(), full);
  }

  /// Adds the rate of p M / (bulk eta).
  void add_bulk_rate(const FlowInputs& in, const double* p, const FlowTangent<D>& rate,
                     double d_viscosity, double* q) const {
    const double inverse_bulk = 1.0 / (options().bulk * in.viscosity);
    for (std::int64_t cell = 0; cell < grid().num_cells; ++cell)
      q[cell] +=
          p[cell] * inverse_bulk *
          (rate.pressure_volume(cell) - d_viscosity / in.viscosity * op().pressure_volume(cell));
  }

  /// Adds the rate of V m - f V, m = (V.p) / (bulk eta W), in closed regions.
  /// @param p with its level
  void add_closed_rate(const FlowInputs& in, std::int64_t k, const double* v,
                       const double* d_lifted, const double* d_wall, const double* p,
                       const Sums& forced, const FlowTangent<D>& rate, double d_viscosity,
                       double* q, ThreadPool& pool) const {
    if (closed().cells().empty()) return;
    const double bulk = options().bulk * in.viscosity;
    std::vector<double> lifted(u(grid().num_nodes * D)), C(u(grid().num_cells)),
        by_geometry(u(grid().num_cells), 0.0);
    lift_case(v, lifted.data());
    op().outflow(d_lifted, d_wall, C.data(), pool);
    rate.add_mass(lifted.data(), data_of(in, k).wall_velocity, by_geometry.data(), pool);
    const Sums d_lifted_mass =
        closed().sums([&](const Cell& c) { return C[u(c.cell)] + by_geometry[u(c.cell)]; });
    const Sums Vp = closed().sums([&](const Cell& c) { return c.volume * p[c.cell]; });
    const Sums d_Vp =
        closed().sums([&](const Cell& c) { return rate.fluid_volume(c.cell) * p[c.cell]; });
    const Sums d_V = closed().sums([&](const Cell& c) { return rate.fluid_volume(c.cell); });
    const Sums d_W = closed().sums([&](const Cell& c) {
      return c.ratio * (2.0 * rate.fluid_volume(c.cell) - c.ratio * rate.pressure_volume(c.cell));
    });
    for (const Cell& c : closed().cells()) {
      const std::size_t i = u(c.region);
      const double W = closed().weight(c.region), V = closed().volume(c.region);
      const double m = Vp[i] / (bulk * W);
      const double d_m = d_Vp[i] / (bulk * W) - m * (d_W[i] / W + d_viscosity / in.viscosity);
      const double d_forced = (d_lifted_mass[i] - forced[i] * d_V[i]) / V;
      q[c.cell] += (m - forced[i]) * rate.fluid_volume(c.cell) + c.volume * (d_m - d_forced);
    }
  }

  /// Its transpose, and that of taking the level off p: derivatives of pi (V m - f V) and of
  /// given_mean V.p by V, M and C(lifted values, g); returns that by the viscosity.
  /// @param p, pressure with and without its level
  double closed_gradient(double viscosity, const double* p, const double* pressure,
                         const double* pi, const Sums& forced, const Sums& given_mean,
                         double* by_volume, double* by_mass, double* by_lifted) const {
    const double bulk = options().bulk * viscosity;
    const Sums Vp = closed().sums([&](const Cell& c) { return c.volume * p[c.cell]; });
    const Sums Vpi = closed().sums([&](const Cell& c) { return c.volume * pi[c.cell]; });
    double by_viscosity = 0.0;
    for (std::size_t i = 0; i < Vp.size(); ++i) {
      const double W = closed().weight(static_cast<std::int64_t>(i));
      if (W > 0.0) by_viscosity -= Vp[i] * Vpi[i] / (bulk * W * viscosity);
    }
    for (const Cell& c : closed().cells()) {
      const std::size_t i = u(c.region);
      const double W = closed().weight(c.region), V = closed().volume(c.region);
      const double m = Vp[i] / (bulk * W), by_W = -m * Vpi[i] / W;
      by_volume[c.cell] = (m - forced[i]) * pi[c.cell] + p[c.cell] * Vpi[i] / (bulk * W) +
                          2.0 * by_W * c.ratio + Vpi[i] * forced[i] / V +
                          given_mean[i] * pressure[c.cell];
      by_mass[c.cell] = -by_W * c.ratio * c.ratio;
      by_lifted[c.cell] = -Vpi[i] / V;
    }
    return by_viscosity;
  }

  FlowReport report_;
  double start_;
  FlowSpace<D> space_;
  FlowInverse<D> inverse_;
};

}  // namespace

std::shared_ptr<StokesSystem> make_stokes_system(const FlowGeometryInputs& in,
                                                 const FlowOptions& options, StokesPlan& plan,
                                                 ThreadPool& pool) {
  if (in.shape.dim == 2) return std::make_shared<FlowSystem<2>>(in, options, plan, pool);
  return std::make_shared<FlowSystem<3>>(in, options, plan, pool);
}

}  // namespace diffsim
