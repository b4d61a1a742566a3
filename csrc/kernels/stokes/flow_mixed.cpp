#include "kernels/stokes/flow_mixed.h"

#include <algorithm>
#include <cstring>

#include "kernels/linalg/flexible_gmres.h"
#include "kernels/stokes/row_chunks.h"
#include "kernels/subscript.h"

namespace diffsim {
namespace {

// Weight gamma of C' M^-1 C, and its largest share of the bulk modulus, which keeps bulk - gamma
// positive. By measurement: with 1 and 2 about as many iterations, with 10 1.4 times, with 30 2.5.
constexpr double kGamma = 3.0, kLargestGamma = 0.5;
// With 3 incompressible flows take 0.7 of the iterations, too, but their adjoints stall at 3e-12
// where a residual of 1e-12 is asked.
constexpr double kGammaIncompressible = 10.0;
// Pressures that hardly anything holds need a long memory: with 50 directions an incompressible
// flow took three times the iterations.
constexpr int kRestart = 300;

}  // namespace

template <int D>
FlowMixed<D>::FlowMixed(const FlowOperator<D>& op, const ClosedRegions<D>& closed,
                        const FlowMatrix<D>& matrix, const std::uint8_t* fixed, ThreadPool& pool)
    : op_(op),
      closed_(closed),
      gamma_(std::min(op.options().incompressible ? kGammaIncompressible : kGamma,
                      kLargestGamma * op.options().bulk)),
      divergence_scale_(op.geometry().grid().h_min / op.geometry().grid().cell_volume),
      velocity_scale_(op.geometry().grid().h_min * op.geometry().grid().h_min /
                      op.geometry().grid().cell_volume),
      fixed_(active_fixed(op, fixed)),
      divergence_(op, fixed_, divergence_scale_) {
  const FlowGeometry<D>& geometry = op.geometry();
  matrix_.indptr = matrix.indptr();
  matrix_.columns = matrix.template columns<std::int32_t>();
  matrix_.rows = matrix.shared_rows(fixed);
  matrix_.values = matrix.assemble(fixed, gamma_, matrix_.rows, pool);
  matrix.merge_equal(matrix_.rows, matrix_.values);
  matrix_.values.push_back(0.0);  // rows of blocks are read four numbers at a time
  matrix_.values.shrink_to_fit();
  for (double& value : matrix_.values) value *= velocity_scale_;
  const std::vector<std::int64_t>& nodes = geometry.active_nodes();
  num_velocities_ = static_cast<std::int64_t>(nodes.size()) * D;
  NodePositions<D> positions(nodes.size());
  for (std::size_t i = 0; i < nodes.size(); ++i) {
    std::int64_t at[D];
    geometry.grid().node_position(nodes[i], at);
    for (std::size_t a = 0; a < D; ++a) positions[i][a] = static_cast<std::int32_t>(at[a]);
  }
  set_compliances();
  inverse_diagonal_ = invert_diagonals(matrix.diagonal(matrix_.values, matrix_.rows), divergence_,
                                       mass_, gamma_, pool);
  schur_ = std::make_unique<FlowSchur<D>>(op, divergence_, inverse_diagonal_, mass_, compliance_,
                                          gamma_, pool);
  multigrid_ = std::make_unique<FlowMultigrid<D>>(matrix_, positions, fixed_, 1.0, pool);
}

template <int D>
void FlowMixed<D>::set_compliances() {
  const FlowOptions& options = op_.options();
  for (std::int64_t cell = 0; cell < divergence_.size(); ++cell) {
    const std::int64_t at = divergence_.grid_cell(cell);
    const double M = op_.pressure_volume(at) / op_.geometry().grid().cell_volume;
    const bool held = strict() && !divergence_.rigid(cell);
    mass_.push_back(M);
    shift_.push_back(held ? 0.0 : M / (options.bulk - gamma_));
    compliance_.push_back(held ? kLeastCompliance * op_.geometry().fraction(at) : M / options.bulk);
  }
}

template <int D>
typename ClosedRegions<D>::Sums FlowMixed<D>::closed_sums(const double* p) const {
  typename ClosedRegions<D>::Sums sum = closed_.sums(
      [&](const auto& c) { return strict() ? c.volume * p[divergence_.number(c.cell)] : 0.0; });
  for (std::size_t i = 0; i < sum.size(); ++i) {
    const double W = closed_.weight(static_cast<std::int64_t>(i));
    if (W > 0.0) sum[i] /= (op_.options().bulk - gamma_) * W;
  }
  return sum;
}

/// One row of a matrix of blocks times x, of which an entry more than the last is read.
template <int D>
void block_row(const double* A, const std::int32_t* columns, std::int64_t count, const double* x,
               double* s) {
  if constexpr (D == 3) {
    using Four = double __attribute__((vector_size(32)));
    Four sum[3] = {};  // by row: three chains that do not wait for each other
    for (std::int64_t k = 0; k < count; ++k, A += 9) {
      Four v, row[3];
      std::memcpy(&v, x + std::int64_t{columns[k]} * 3, sizeof v);
      for (int a = 0; a < 3; ++a) std::memcpy(&row[a], A + 3 * a, sizeof row[a]);
      for (int a = 0; a < 3; ++a) sum[a] += row[a] * v;
    }
    for (int a = 0; a < 3; ++a) s[a] = sum[a][0] + sum[a][1] + sum[a][2];
  } else {
    double sum[D][D] = {};
    for (std::int64_t k = 0; k < count; ++k, A += D * D)
      for (int a = 0; a < D; ++a)
        for (int b = 0; b < D; ++b) sum[a][b] += A[a * D + b] * x[std::int64_t{columns[k]} * D + b];
    for (int a = 0; a < D; ++a) {
      s[a] = 0.0;
      for (int b = 0; b < D; ++b) s[a] += sum[a][b];
    }
  }
}

template <int D>
void FlowMixed<D>::apply(const Vector& x, Vector& y, ThreadPool& pool) const {
  const double* p = x.data() + num_velocities_;
  for_chunks(matrix_.num_nodes(), pool, [&](std::int64_t i) {
    const std::int64_t first = matrix_.indptr[u(i)];
    double s[D];
    block_row<D>(matrix_.values.data() + matrix_.rows.first(i) * D * D,
                 matrix_.columns.data() + first, matrix_.indptr[u(i) + 1] - first, x.data(), s);
    for (int a = 0; a < D; ++a) y[u(i * D + a)] = s[a];
  });
  divergence_.add_gradient(-1.0, p, y.data(), pool);
  double* q = y.data() + num_velocities_;
  divergence_.take(x.data(), q, pool);
  for (std::size_t cell = 0; cell < shift_.size(); ++cell) q[cell] += shift_[cell] * p[cell];
  if (!strict()) return;
  const auto sum = closed_sums(p);
  const double cell_volume = op_.geometry().grid().cell_volume;
  for (const auto& c : closed_.cells())
    q[divergence_.number(c.cell)] += c.volume / cell_volume * sum[u(c.region)];
}

template <int D>
void FlowMixed<D>::precondition(const Vector& r, Vector& z, ThreadPool& pool) {
  double* p = z.data() + num_velocities_;
  schur_->apply(r.data() + num_velocities_, p, pool);
  std::copy_n(r.begin(), num_velocities_, scratch_.begin());
  divergence_.add_gradient(1.0, p, scratch_.data(), pool);
  multigrid_->apply(scratch_.data(), z.data(), pool);
}

template <int D>
KrylovResult FlowMixed<D>::solve(const double* f, const double* g, double* v, double* p,
                                 double rtol, int max_iters, ThreadPool& pool) {
  const std::vector<std::int64_t>& nodes = op_.geometry().active_nodes();
  const std::size_t num_velocities = u(num_velocities_), num_cells = shift_.size();
  Vector b(num_velocities + num_cells), x;
  scratch_.resize(num_velocities);
  for (std::size_t i = 0; i < num_velocities; ++i)
    b[i] =
        fixed_[i] ? 0.0 : velocity_scale_ * f[nodes[i / D] * D + static_cast<std::int64_t>(i % D)];
  Vector pressure(num_cells);
  for (std::size_t cell = 0; cell < num_cells; ++cell) {
    b[num_velocities + cell] =
        divergence_scale_ * g[divergence_.grid_cell(static_cast<std::int64_t>(cell))];
    pressure[cell] = b[num_velocities + cell] / mass_[cell];
  }
  divergence_.add_gradient(gamma_, pressure.data(), b.data(), pool);
  VectorOps ops(pool);
  const double size = ops.norm(b);
  KrylovResult result =
      flexible_gmres<float>([&](const Vector& in, Vector& out) { apply(in, out, pool); },
                            [&](const Vector& in, Vector& out) { precondition(in, out, pool); }, b,
                            x, false, rtol * size, max_iters, kRestart, ops);
  result.residual_norm = size > 0.0 ? result.residual_norm / size : 0.0;
  for (std::size_t i = 0; i < num_velocities; ++i)
    if (!fixed_[i]) v[nodes[i / D] * D + static_cast<std::int64_t>(i % D)] = x[i];
  const double by_gamma = strict() ? 1.0 : 1.0 / (1.0 - gamma_ / op_.options().bulk);
  double* q = x.data() + num_velocities;
  if (strict()) {
    const auto sum = closed_sums(q);
    for (const auto& c : closed_.cells())
      q[divergence_.number(c.cell)] += gamma_ * c.ratio * sum[u(c.region)];
  }
  for (std::size_t cell = 0; cell < num_cells; ++cell)
    p[divergence_.grid_cell(static_cast<std::int64_t>(cell))] =
        q[cell] * by_gamma / op_.geometry().grid().h_min;
  return result;
}

template <int D>
std::int64_t FlowMixed<D>::bytes() const {
  return static_cast<std::int64_t>(matrix_.values.size() * 8 + matrix_.columns.size() * 4) +
         schur_->bytes() + multigrid_->bytes();
}

template class FlowMixed<2>;
template class FlowMixed<3>;

}  // namespace diffsim
