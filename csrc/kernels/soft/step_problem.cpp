#include "kernels/soft/step_problem.h"

#include "kernels/soft/elastic_second.h"
#include "kernels/soft/pressure.h"
#include "kernels/soft/shape_derivatives.h"
#include "kernels/subscript.h"

namespace diffsim {
namespace {

double force_scale(const ConstantSystem& system, const StepInputs& in) {
  const std::int64_t n = system.model().num_nodes;
  const double* inertia = in.inertia ? in.inertia : system.inertia();
  double mean[3] = {0, 0, 0};
  for (std::int64_t i = 0; i < n; ++i)
    for (int axis = 0; axis < 3; ++axis) mean[axis] += in.y[3 * i + axis] / static_cast<double>(n);
  double momentum = 0.0, force = 0.0;
  for (std::int64_t i = 0; i < n; ++i)
    for (int axis = 0; axis < 3; ++axis) {
      if (system.fixed()[3 * i + axis]) continue;
      const double m = inertia[i] * (in.y[3 * i + axis] - mean[axis]);
      momentum += m * m;
      force += in.force[3 * i + axis] * in.force[3 * i + axis];
    }
  return std::sqrt(momentum) + std::sqrt(force);
}

constexpr std::int64_t kJacobiNodes = 4096;  // of a task
// A factor above this is of single precision where that is enough: one of a ball of 177k DoF that
// lands takes 1.5 s then, not 3.4, and 0.35 GiB less. Smaller ones are not worth their digits.
constexpr std::int64_t kLargeFactorBytes = std::int64_t{1} << 28;

/// Inverse of a node's own block of H, by cofactors, as a lower triangle by rows; zero on fixed
/// unknowns. Of a block that is not positive definite the diagonal is inverted, without its sign.
void invert_jacobi(const double* block, double inertia, const std::uint8_t* fixed,
                   double inverse[6]) {
  double a[6];
  for (int i = 0, k = 0; i < 3; ++i)
    for (int j = 0; j <= i; ++j, ++k)
      a[k] = fixed[i] || fixed[j] ? (i == j ? 1.0 : 0.0)
                                  : block[block3_place(i, j)] + (i == j ? inertia : 0.0);
  const double minor = a[0] * a[2] - a[1] * a[1];
  inverse[0] = a[2] * a[5] - a[4] * a[4];
  inverse[1] = a[3] * a[4] - a[1] * a[5];
  inverse[3] = a[1] * a[4] - a[2] * a[3];
  const double determinant = a[0] * inverse[0] + a[1] * inverse[1] + a[3] * inverse[3];
  if (a[0] > 0.0 && minor > 0.0 && determinant > 0.0) {
    inverse[2] = a[0] * a[5] - a[3] * a[3];
    inverse[4] = a[1] * a[3] - a[0] * a[4];
    inverse[5] = minor;
    for (int k = 0; k < 6; ++k) inverse[k] /= determinant;
  } else {
    inverse[1] = inverse[3] = inverse[4] = 0.0;
    for (const int k : {0, 2, 5}) inverse[k] = 1.0 / std::max(std::abs(a[k]), 1e-300);
  }
  if (fixed[0]) inverse[0] = 0.0;
  if (fixed[1]) inverse[2] = 0.0;
  if (fixed[2]) inverse[5] = 0.0;
}

}  // namespace

StepProblem::StepProblem(const ConstantSystem& system, const StepInputs& inputs, ThreadPool& pool,
                         bool by_multigrid)
    : system_(system),
      in_(inputs),
      pool_(pool),
      ops_(pool),
      size_(at(3 * system.model().num_nodes)),
      scale_(force_scale(system, inputs)),
      memory_(system.pattern().memories().take()),
      by_multigrid_(by_multigrid) {
  memory_->elastic.keep_samples = true;
  memory_->elastic.stresses_alone = false;
  if (in_.parameters.damp_mu)
    frames_ = damping_frames(system.model(), in_.x_frame, in_.x_velocity, pool);
}

StepProblem::~StepProblem() {
  if (!factor_.empty()) memory_->factor = factor_[0].take_memory();
  system_.pattern().memories().give_back(std::move(memory_));
}

double StepProblem::value_gradient(const Vector& x, Vector& gradient) {
  gradient.resize(size_);
  energy_ = energy_gradient(system_.model(), in_.parameters, frames_, x.data(), gradient.data(),
                            memory_->elastic, pool_);
  const double inflation = add_pressure_gradient(system_.model(), in_.parameters.pressure, x.data(),
                                                 gradient.data(), pool_);
  double kinetic = 0.0, work = 0.0;
  for (std::size_t i = 0; i < size_; ++i) {
    const double m = inertia()[i / 3], step = x[i] - in_.y[i];
    if (!system_.fixed()[i]) {
      kinetic += 0.5 * m * step * step;
      work += in_.force[i] * step;
    }
    gradient[i] += m * step - in_.force[i];
  }
  zero_fixed(gradient);
  magnitude_ = kinetic + std::abs(work) + energy_ + std::abs(inflation);
  return kinetic - work + energy_ + inflation;
}

void StepProblem::assemble(const Vector& x, bool clamp, bool by_old_multigrid) {
  if (!is_multigrid_kept_ && (is_multigrid_stale_ || !by_old_multigrid)) {
    assembled_at_ = x;
    is_multigrid_stale_ = by_multigrid_;
  }
  jacobi_.clear();
  memory_->values.resize(at(system_.model().values_size()));
  tangent(system_.model(), in_.parameters, frames_, x.data(), clamp, memory_->values.data(),
          memory_->elastic, pool_);
  // Clamped, the matrix must be definite, which the geometric stiffness of a pressure is not.
  if (!clamp)
    add_pressure_tangent(system_.model(), in_.parameters.pressure, x.data(), memory_->values.data(),
                         pool_);
}

void StepProblem::add_small_tangent(const Vector& x, const SmallTables& tables, SmallCholesky& to) {
  const SoftModel& model = system_.model();
  diffsim::add_small_tangent(model, in_.parameters, frames_, x.data(), tables.places,
                             memory_->elastic, to);
  for (std::int64_t i = 0; i < model.num_nodes; ++i) {
    double* block = to.block(tables.pattern.place(model.diagonal[at(i)]).block);
    for (int axis = 0; axis < 3; ++axis) block[(SmallCholesky::kColumn + 1) * axis] += inertia()[i];
  }
}

void StepProblem::multiply_all(const Vector& in, Vector& out) {
  out.resize(size_);
  block_multiply(system_.model(), memory_->values.data(), inertia(), in.data(), out.data(), pool_);
}

Vector StepProblem::left_at_fixed(const double* grad_x, const Vector& z) {
  Vector left(size_, 0.0);
  block_multiply(system_.model(), memory_->values.data(), inertia(), z.data(), left.data(), pool_,
                 system_.fixed());
  for (std::size_t i = 0; i < size_; ++i) left[i] = system_.fixed()[i] ? grad_x[i] - left[i] : 0.0;
  return left;
}

void StepProblem::multiply(const Vector& in, Vector& out) {
  multiply_all(in, out);
  zero_fixed(out);
}

void StepProblem::zero_fixed(Vector& v) const {
  for (std::size_t i = 0; i < size_; ++i)
    if (system_.fixed()[i]) v[i] = 0.0;
}

Vector StepProblem::quadratic_gradients(const Vector& x, const Vector& z, const Vector& rest,
                                        const StepAdjoint& out) {
  const double* inertia = this->inertia();
  Vector minus_z(z);
  for (double& v : minus_z) v = -v;
  for (std::size_t i = 0; i < size_; ++i) {
    out.y[i] = inertia[i / 3] * z[i];
    out.force[i] = z[i];
    out.target[i] = system_.fixed()[i] ? rest[i] : 0.0;
    if (!out.inertia) continue;
    if (i % 3 == 0) out.inertia[i / 3] = 0.0;
    out.inertia[i / 3] -= z[i] * (x[i] - in_.y[i]);
  }
  damping_adjoint(system_.model(), in_.parameters, frames_, x.data(), minus_z.data(),
                  out.parameters, memory_->elastic, pool_);
  return minus_z;
}

void StepProblem::input_gradients(const Vector& x, const Vector& z, const Vector& rest,
                                  const StepAdjoint& out) {
  const SoftModel& model = system_.model();
  const Vector minus_z = quadratic_gradients(x, z, rest, out);
  parameter_adjoint(model, in_.parameters, x.data(), minus_z.data(), out.parameters,
                    memory_->elastic, pool_);
  shape_adjoint(model, in_.parameters, frames_, x.data(), nullptr, minus_z.data(), out.parameters,
                pool_);
  pressure_adjoint(model, x.data(), minus_z.data(), out.parameters.pressure, pool_);
}

void StepProblem::linear_input_gradients(const Vector& x, const Vector& z, const Vector& rest,
                                         const StepAdjoint& out) {
  const SoftModel& model = system_.model();
  const Vector minus_z = quadratic_gradients(x, z, rest, out);
  Vector d(x);
  for (std::size_t i = 0; i < size_; ++i) d[i] -= in_.guess[i];
  linearized_adjoint(model, in_.parameters, in_.guess, d.data(), minus_z.data(), out.guess,
                     out.parameters, memory_->elastic, pool_);
  shape_adjoint(model, in_.parameters, frames_, in_.guess, d.data(), minus_z.data(), out.parameters,
                pool_);
  linearized_pressure_adjoint(model, in_.parameters.pressure, in_.guess, d.data(), minus_z.data(),
                              out.guess, out.parameters.pressure, pool_);
}

void StepProblem::parameter_tangent(const Vector& x, std::int64_t count,
                                    const ParameterDirections& directions, double* out) {
  diffsim::parameter_tangent(system_.model(), in_.parameters, frames_, x.data(), count, directions,
                             out, memory_->elastic, pool_);
}

void StepProblem::load_tangents(const Vector& x, const StepDirections& d, double* out) {
  const SoftModel& model = system_.model();
  const std::int64_t size = static_cast<std::int64_t>(size_);
  parameter_tangent(x, d.count, d.parameters, out);
  for (std::int64_t k = 0; k < d.count; ++k) {
    double* b = out + k * size;
    if (d.parameters.pressure)
      add_pressure_gradient(model, d.parameters.pressure + k * model.chambers.num_chambers,
                            x.data(), b, pool_);
    for (std::int64_t i = 0; i < size; ++i) {
      b[i] = -b[i];
      if (d.y) b[i] += inertia()[i / 3] * d.y[k * size + i];
      if (d.force) b[i] += d.force[k * size + i];
      if (d.inertia) b[i] -= d.inertia[k * model.num_nodes + i / 3] * (x[at(i)] - in_.y[i]);
    }
  }
}

void StepProblem::linear_load_tangents(const Vector& x, const StepDirections& directions,
                                       double* out) {
  // Inertia, loads and damping are linear in x already: theirs are those of a step that ends in x.
  StepDirections linear = directions;
  ParameterDirections& rest = linear.parameters;
  rest.weights = rest.fiber_stiffness = rest.activation = rest.pressure = rest.tables = nullptr;
  load_tangents(x, linear, out);
  const SoftModel& model = system_.model();
  const Vector q(in_.guess, in_.guess + size_), still(size_, 0.0);
  Vector d(x), force(size_);
  for (std::size_t i = 0; i < size_; ++i) d[i] -= q[i];
  for (std::int64_t k = 0; k < directions.count; ++k) {
    const std::size_t begin = at(k) * size_;
    const double* dq = directions.guess ? directions.guess + begin : still.data();
    linearized_tangent(model, in_.parameters, frames_, q.data(), d.data(), dq,
                       directions.parameters, k, force.data(), memory_->elastic, pool_);
    linearized_pressure_adjoint(model, in_.parameters.pressure, q.data(), d.data(), dq,
                                force.data(), nullptr, pool_);
    if (directions.parameters.pressure)
      add_linearized_pressure(model,
                              directions.parameters.pressure + k * model.chambers.num_chambers,
                              q.data(), d.data(), force.data(), pool_);
    for (std::size_t i = 0; i < size_; ++i) out[begin + i] -= force[i];
  }
}

void StepProblem::prepare_multigrid() {
  if (!memory_->multigrid)
    memory_->multigrid = std::make_unique<RigidMultigrid>(system_.pattern().hierarchy());
  const SoftModel& model = system_.model();
  const BlockMatrix matrix{model.num_nodes, memory_->values.data(), inertia(), system_.fixed(),
                           &held_};
  memory_->multigrid->prepare(matrix, assembled_at_.data(), pool_);
  is_multigrid_stale_ = false;
}

void StepProblem::hold_nodes(std::vector<HeldNode> held) {
  held_ = std::move(held);
  is_multigrid_stale_ = by_multigrid_;
}

void StepProblem::keep_multigrid() {
  prepare_multigrid();
  is_multigrid_kept_ = true;
}

void StepProblem::precondition(const Vector& r, Vector& z) {
  if (!by_multigrid_) {
    solve_constant(r, z);
    return;
  }
  if (is_multigrid_stale_) prepare_multigrid();
  ++num_solves;
  memory_->multigrid->apply(r, z, pool_);
}

void StepProblem::solve_constant(const Vector& r, Vector& z) {
  ++num_solves;
  system_.solve(r, z, constant_, pool_);
}

const double* StepProblem::diagonal_block(std::int64_t i) const {
  const SoftModel& model = system_.model();
  return memory_->values.data() + kBlock3 * model.diagonal[at(i)];
}

void StepProblem::prepare_jacobi() {
  const std::int64_t n = system_.model().num_nodes;
  jacobi_.resize(at(6 * n));
  pool_.run_ranges(n, kJacobiNodes, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i)
      invert_jacobi(diagonal_block(i), inertia()[i], system_.fixed() + 3 * i, &jacobi_[at(6 * i)]);
  });
}

void StepProblem::solve_jacobi(const Vector& r, Vector& z) {
  if (jacobi_.empty()) prepare_jacobi();
  pool_.run_ranges(system_.model().num_nodes, kJacobiNodes, [&](std::int64_t i, std::int64_t end) {
    for (; i < end; ++i) {
      const double *c = &jacobi_[at(6 * i)], *b = &r[at(3 * i)];
      double* out = &z[at(3 * i)];
      out[0] = c[0] * b[0] + c[1] * b[1] + c[3] * b[2];
      out[1] = c[1] * b[0] + c[2] * b[1] + c[4] * b[2];
      out[2] = c[3] * b[0] + c[4] * b[1] + c[5] * b[2];
    }
  });
}

bool StepProblem::factorize_roughly(const std::function<void(double*)>& edit) {
  const bool is_large = CholeskyFactor(system_.pattern().blocks()).bytes() > kLargeFactorBytes;
  return factorize(edit, is_large ? FactorPrecision::kFloat32 : FactorPrecision::kFloat64);
}

bool StepProblem::factorize(const std::function<void(double*)>& edit, FactorPrecision precision) {
  const SoftModel& model = system_.model();
  blocks_.resize(at(9 * model.num_blocks()));
  double diagonal = 0.0;
  for (std::int64_t i = 0; i < model.num_nodes; ++i) diagonal += inertia()[i];
  for (std::int64_t i = 0; i < model.num_nodes; ++i) diagonal += diagonal_block(i)[0];
  export_blocks(model, memory_->values.data(), inertia(), system_.fixed(),
                diagonal / static_cast<double>(model.num_nodes), blocks_.data(), pool_);
  if (edit) edit(blocks_.data());
  if (factor_.empty())
    factor_.emplace_back(system_.pattern().blocks(), precision, std::move(memory_->factor));
  ++num_factorizations;
  try {
    factor_[0].refactor(blocks_.data(), pool_);
  } catch (const NotPositiveDefinite&) {
    return false;
  }
  return true;
}

void StepProblem::solve_factorized(const Vector& r, Vector& z) {
  z.resize(size_);
  factor_[0].solve(r.data(), z.data(), 1, cholesky_, pool_);
}

void StepProblem::solve_factorized_many(double* columns, int count) {
  factor_[0].solve(columns, columns, count, cholesky_, pool_);
}

void StepProblem::inverse_among(const std::vector<std::int64_t>& nodes, double* inverse) {
  std::vector<std::int64_t> unknowns;
  for (const std::int64_t node : nodes)
    for (std::int64_t axis = 0; axis < 3; ++axis) unknowns.push_back(3 * node + axis);
  factor_[0].inverse_among(unknowns.data(), static_cast<std::int64_t>(unknowns.size()), inverse,
                           cholesky_, pool_);
}

}  // namespace diffsim
