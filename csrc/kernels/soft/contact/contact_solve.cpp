#include "kernels/soft/contact/contact_solve.h"

#include <limits>

namespace diffsim {

ContactSolve::ContactSolve(StepProblem& problem, const ConstantSystem& system,
                           const ContactSpace& space, StepMethod method, double rtol,
                           bool cache_columns, ThreadPool& pool)
    : problem_(problem),
      system_(system),
      space_(space),
      method_(method),
      rtol_(rtol),
      preconditioner_(problem, system, space, cache_columns, pool) {}

void ContactSolve::choose() {
  if (method_ == StepMethod::kNewtonJacobi) kind_ = Kind::kJacobi;
  if (method_ == StepMethod::kNewtonCholesky) kind_ = Kind::kTangent;
  if (method_ != StepMethod::kAuto || kind_ == Kind::kTangent) return;
  const SolverPlan& plan = system_.plan();
  const double digits = decades(rtol_) / kProbeDigits;  // in units of the plan's iterations
  const double constant = preconditioner_.constant_cost(digits * plan.iterations);
  // Diagonal blocks know nothing of the stiffness that friction adds across the slip.
  const double jacobi = space_.any_sliding_friction()
                            ? std::numeric_limits<double>::infinity()
                            : digits * plan.jacobi_iterations * plan.jacobi_cost;
  kind_ = jacobi < constant ? Kind::kJacobi : Kind::kConstant;
  if (std::min(constant, jacobi) > preconditioner_.tangent_cost() ||
      spent_ > plan.patience(kind_ == Kind::kJacobi ? plan.jacobi_cost : plan.iteration_cost))
    kind_ = Kind::kTangent;
}

void ContactSolve::prepare() {
  choose();
  const bool old_factor =
      preconditioner_.on_tangent() && stale_matrix_ &&
      (method_ == StepMethod::kNewtonCholesky || age_ >= system_.plan().refactor_after());
  if (kind_ == Kind::kConstant && stale_statuses_) preconditioner_.prepare_constant();
  if (kind_ == Kind::kTangent && (stale_statuses_ || old_factor || !preconditioner_.on_tangent())) {
    age_ = 0;
    if (!preconditioner_.prepare_tangent()) preconditioner_.prepare_constant();
  }
  stale_statuses_ = stale_matrix_ = false;
}

bool ContactSolve::prepare_tangent() {
  kind_ = Kind::kTangent;
  stale_statuses_ = stale_matrix_ = false;
  return preconditioner_.prepare_tangent();
}

void ContactSolve::precondition(const Vector& in, Vector& out) {
  if (kind_ == Kind::kJacobi) {
    problem_.solve_jacobi(in, out);
    space_.project(out);
  } else {
    preconditioner_.apply(in, out);
  }
}

template <typename Apply>
KrylovResult ContactSolve::iterate(Apply&& apply, const Vector& r, double tolerance, int max_iters,
                                   Vector& q) {
  prepare();
  const auto precondition = [this](const Vector& in, Vector& out) { this->precondition(in, out); };
  KrylovResult result;
  if (space_.any_sliding_friction())
    result = gmres(apply, precondition, r, q, tolerance, max_iters, problem_.ops());
  else
    result = conjugate_gradients(apply, precondition, r, q, false, tolerance, max_iters, krylov_,
                                 problem_.ops());
  (preconditioner_.on_tangent() ? age_ : spent_) += result.num_iters;
  return result;
}

void ContactSolve::apply(const Vector& in, Vector& out) {
  problem_.multiply(in, out);
  space_.reduce(out);
  space_.add_slip_stiffness(in, out);
}

KrylovResult ContactSolve::solve(const Vector& r, double tolerance, int max_iters, Vector& q) {
  const auto apply = [this](const Vector& in, Vector& out) { this->apply(in, out); };
  return iterate(apply, r, tolerance, max_iters, q);
}

void ContactSolve::apply_transposed(const Vector& in, Vector& out) {
  expanded_ = in;
  space_.expand(expanded_);
  problem_.multiply(expanded_, out);
  space_.project(out);
  space_.add_slip_stiffness(in, out);
}

KrylovResult ContactSolve::solve_transposed(const Vector& r, double tolerance, int max_iters,
                                            Vector& p) {
  const auto apply = [this](const Vector& in, Vector& out) { apply_transposed(in, out); };
  return iterate(apply, r, tolerance, max_iters, p);
}

KrylovResult ContactSolve::solve_indefinite(const Vector& r, double tolerance, int max_iters,
                                            Vector& q) {
  const auto apply = [this](const Vector& in, Vector& out) { this->apply(in, out); };
  const auto precondition = [this](const Vector& in, Vector& out) { this->precondition(in, out); };
  return gmres(apply, precondition, r, q, tolerance, max_iters, problem_.ops());
}

KrylovResult ContactSolve::solve_indefinite_transposed(const Vector& r, double tolerance,
                                                       int max_iters, Vector& p) {
  const auto apply = [this](const Vector& in, Vector& out) { apply_transposed(in, out); };
  const auto precondition = [this](const Vector& in, Vector& out) { this->precondition(in, out); };
  return gmres(apply, precondition, r, p, tolerance, max_iters, problem_.ops());
}

}  // namespace diffsim
