#include "kernels/stokes/flow_pressures.h"

#include <limits>

#include "kernels/subscript.h"

namespace diffsim {
namespace {

double dot(const std::vector<double>& a, const double* b) {
  double sum = 0.0;
  for (std::size_t i = 0; i < a.size(); ++i) sum += a[i] * b[i];
  return sum;
}

double square(double x) { return x * x; }

// Of a cell's divergence, in units of the last place of its terms.
constexpr double kRoundingOfDivergence = 4.0;

}  // namespace

template <int D>
FlowPressures<D>::FlowPressures(const FlowSpace<D>& space, const FlowMatrix<D>& matrix,
                                const std::vector<double>& values, ThreadPool& pool)
    : space_(space),
      fixed_(active_fixed(space.op(), space.fixed())),
      divergence_(space.op(), fixed_, 1.0),
      given_(u(divergence_.size())),
      found_(u(divergence_.size())) {
  const double bulk = space.options().bulk;
  for (std::int64_t cell = 0; cell < divergence_.size(); ++cell) {
    const std::int64_t at = divergence_.grid_cell(cell);
    mass_.push_back(op().pressure_volume(at));
    compliance_.push_back(divergence_.rigid(cell) ? op().pressure_volume(at) / bulk
                                                  : kLeastCompliance * op().fluid_volume(at));
  }
  inverse_diagonal_ =
      invert_diagonals(matrix.diagonal(values, matrix.own_rows()), divergence_, mass_, bulk, pool);
  schur_ = std::make_unique<FlowSchur<D>>(op(), divergence_, inverse_diagonal_, mass_, compliance_,
                                          bulk, pool);
  set_rounding(pool);
}

/// The pressures' error that rounding of the divergence leaves, for eta = 1 and |v| = 1.
template <int D>
void FlowPressures<D>::set_rounding(ThreadPool& pool) {
  for (std::int64_t cell = 0; cell < divergence_.size(); ++cell) {
    given_[u(cell)] = 0.0;
    for (int i = 0; i < (1 << D) * D; ++i)
      given_[u(cell)] += kRoundingOfDivergence * std::numeric_limits<double>::epsilon() *
                         std::abs(divergence_.row(cell)[i]);
  }
  schur_->apply(given_.data(), found_.data(), pool);
  double sum = 0.0;
  for (std::size_t cell = 0; cell < found_.size(); ++cell)
    sum += square(found_[cell] - space_.options().bulk / mass_[cell] * given_[cell]);
  rounding_ = std::sqrt(sum);
}

template <int D>
void FlowPressures<D>::precondition(double eta, const double* remainder, double* pressure,
                                    ThreadPool& pool) {
  for (std::int64_t cell = 0; cell < divergence_.size(); ++cell)
    given_[u(cell)] = remainder[divergence_.grid_cell(cell)];
  schur_->apply(given_.data(), found_.data(), pool);
  std::fill(pressure, pressure + space_.grid().num_cells, 0.0);
  for (std::int64_t cell = 0; cell < divergence_.size(); ++cell)
    pressure[divergence_.grid_cell(cell)] = eta * found_[u(cell)];
  space_.skip_rigid(pressure);
  space_.closed().subtract_level(pressure);
}

template <int D>
bool FlowPressures<D>::judge(double eta, double speed, const double* p, const double* remainder,
                             const double* correction, FlowStats& stats) const {
  const FlowOptions& options = space_.options();
  double left = 0.0, size = 0.0;
  for (std::int64_t cell = 0; cell < divergence_.size(); ++cell) {
    const std::int64_t at = divergence_.grid_cell(cell);
    const double held = options.bulk * eta / mass_[u(cell)] * remainder[at];  // is made up for
    left += square(correction[at] - held);
    size += square(p[at] + correction[at]);
  }
  const double unit = eta * speed / space_.longest_side();
  left = std::sqrt(left);
  size = std::max(std::sqrt(size), std::sqrt(static_cast<double>(divergence_.size())) * unit);
  stats.divergence = space_.divergence(remainder, speed);
  stats.pressure_error = left > 0.0 || std::isnan(left) ? left / size : 0.0;
  return stats.divergence <= options.tolerance &&
         (stats.pressure_error <= options.tolerance || left <= eta * speed * rounding_);
}

template <int D>
void FlowPressures<D>::close(double eta, std::int64_t cases, const FactorSolve& solve,
                             const double* v, double* dv, double* p, double* remainder,
                             FlowStats* stats, ThreadPool& pool) {
  const std::int64_t N = space_.grid().num_nodes * D, M = space_.grid().num_cells;
  std::vector<Search> search(u(cases), {std::vector<double>(u(M), 0.0), std::vector<double>(u(M))});
  std::vector<double> rest(u(N), 0.0), r(u(N)), C(u(M)), step(u(N));
  std::vector<double> b(space_.num_unknowns() * u(cases));
  std::vector<std::uint8_t> ended(u(cases), 0);
  while (true) {
    for (std::int64_t k = 0; k < cases; ++k) {
      if (ended[u(k)]) continue;
      Search& s = search[u(k)];
      double* rk = remainder + k * M;
      precondition(eta, rk, s.correction.data(), pool);
      for (std::int64_t i = 0; i < N; ++i) step[u(i)] = v[k * N + i] + dv[k * N + i];
      const bool done =
          judge(eta, space_.speed(step.data()), p + k * M, rk, s.correction.data(), stats[k]);
      stats[k].converged = done;
      ended[u(k)] = done || stats[k].num_iters >= space_.options().max_iters;
      const double product = dot(s.correction, rk);
      const double beta = s.product > 0.0 ? product / s.product : 0.0;
      s.product = product;
      for (std::int64_t cell = 0; cell < M; ++cell)
        s.direction[u(cell)] = s.correction[u(cell)] + beta * s.direction[u(cell)];
    }
    if (std::all_of(ended.begin(), ended.end(), [](std::uint8_t e) { return e != 0; })) return;
    for (std::int64_t k = 0; k < cases; ++k) {
      op().residual(rest.data(), FlowData(), search[u(k)].direction.data(), eta, r.data(), pool);
      space_.gather(r.data(), b.data(), k, cases, -1.0 / eta);
    }
    solve(b.data(), cases);
    for (std::int64_t k = 0; k < cases; ++k) {
      if (ended[u(k)]) continue;
      const Search& s = search[u(k)];
      std::fill(step.begin(), step.end(), 0.0);
      space_.scatter_add(b.data(), k, cases, 1.0, step.data());
      op().outflow(step.data(), nullptr, C.data(), pool);
      space_.skip_rigid(C.data());
      space_.closed().subtract(space_.closed().means(C.data()), C.data());
      const double curvature = dot(s.direction, C.data());
      stats[k].num_iters += 1.0;
      if (!(curvature > 0.0)) {
        ended[u(k)] = 1;
        continue;
      }
      const double alpha = s.product / curvature;
      for (std::int64_t cell = 0; cell < M; ++cell) {
        p[k * M + cell] += alpha * s.direction[u(cell)];
        remainder[k * M + cell] -= alpha * C[u(cell)];
      }
      for (std::int64_t i = 0; i < N; ++i) dv[k * N + i] += alpha * step[u(i)];
    }
  }
}

template class FlowPressures<2>;
template class FlowPressures<3>;

}  // namespace diffsim
