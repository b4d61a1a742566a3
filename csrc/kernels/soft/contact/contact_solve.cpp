#include "kernels/soft/contact/contact_solve.h"

#include <limits>

#include "kernels/linalg/flexible_gmres.h"

namespace diffsim {
namespace {

// Directions of GMRES before it begins anew; bytes that half of them move for each unknown of an
// iteration: of a vector and two neighbors read, one written.
constexpr int kRestart = 60;
constexpr double kBasisBytes = 0.5 * kRestart * 4.0 * sizeof(double);
// Iterations of GMRES on multigrid that halve the residual where H is indefinite or clamped, or
// hardly any number will. Ball that lands, 177k DoF: 0.36 and less is left where they converge,
// 0.65 and more where a hundred do not. Those that took a restart took 347 and left 0.06.
constexpr int kHalvingIterations = 10;
constexpr double kHalf = 0.5;

}  // namespace

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
  const double base = preconditioner_.base_cost(at_answer_ ? 1.0 : kSetupsPerStep,
                                                iterations(plan.contact_iterations));
  // Diagonal blocks know nothing of the stiffness that friction adds across the slip.
  const double jacobi = space_.any_sliding_friction()
                            ? std::numeric_limits<double>::infinity()
                            : iterations(plan.jacobi_iterations) * plan.jacobi_cost;
  kind_ = jacobi < base ? Kind::kJacobi : Kind::kBase;
  const double tangent = at_answer_ ? plan.factorized_cost() : preconditioner_.tangent_cost();
  if (std::min(base, jacobi) > tangent || spent_ > patience()) kind_ = Kind::kTangent;
}

int ContactSolve::patience() const {
  const SolverPlan& plan = system_.plan();
  double cost = kind_ == Kind::kJacobi ? plan.jacobi_cost : plan.iteration_cost;
  if (space_.any_sliding_friction())
    cost += streaming_cost(kBasisBytes * static_cast<double>(problem_.size()));
  return plan.patience(cost);
}

double ContactSolve::iterations(double at_rest) const {
  return at_answer_ ? SolverPlan::answer_iterations(at_rest, rtol_)
                    : at_rest / kProbeDigits * decades(rtol_);
}

void ContactSolve::prepare() {
  choose();
  const bool old_factor =
      preconditioner_.on_tangent() && stale_matrix_ &&
      (method_ == StepMethod::kNewtonCholesky || age_ >= system_.plan().refactor_after());
  // Multigrid is made anew on a new matrix, and takes the slips as they are then.
  const bool stale_base = stale_statuses_ || (stale_matrix_ && problem_.by_multigrid());
  if (kind_ == Kind::kBase && stale_base) preconditioner_.prepare_base();
  if (kind_ == Kind::kTangent && (stale_statuses_ || old_factor || !preconditioner_.on_tangent())) {
    age_ = 0;
    if (!preconditioner_.prepare_tangent()) preconditioner_.prepare_base();
  }
  stale_statuses_ = stale_matrix_ = false;
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
                                   bool is_guess, Vector& q) {
  prepare();
  const auto precondition = [this](const Vector& in, Vector& out) { this->precondition(in, out); };
  // Where the tangent has no factor, being indefinite, iterations are all that is left.
  if (method_ == StepMethod::kAuto && kind_ != Kind::kTangent)
    max_iters = std::min(max_iters, std::max(patience() + 1 - spent_, 1));
  KrylovResult result;
  if (space_.any_sliding_friction()) {
    bool is_given_up = false;
    is_indefinite_ = false;
    const auto gives_up = [&](int iterations, double left) {
      return is_given_up = is_hopeless(iterations, left);
    };
    // Few iterations from a guess leave its rigid motion, of which a residual says little where a
    // small body is stiff; there they cost next to nothing.
    const bool is_warm = is_guess && problem_.by_multigrid();
    result = flexible_gmres<double>(apply, precondition, r, q, is_warm, tolerance, max_iters,
                                    kRestart, problem_.ops(), gives_up);
    result.negative_curvature = is_given_up && is_indefinite_;
  } else {
    result = conjugate_gradients(apply, precondition, r, q, false, tolerance, max_iters, krylov_,
                                 problem_.ops());
  }
  (preconditioner_.on_tangent() ? age_ : spent_) += result.num_iters;
  return result;
}

void ContactSolve::multiply(const Vector& in, Vector& out) {
  problem_.multiply(in, out);
  if (may_give_up()) is_indefinite_ = is_indefinite_ || problem_.ops().dot(in, out) < 0.0;
}

bool ContactSolve::may_give_up() const {
  return space_.any_sliding_friction() && problem_.by_multigrid() && kind_ != Kind::kJacobi &&
         !preconditioner_.on_tangent();
}

bool ContactSolve::is_hopeless(int iterations, double left) const {
  if (!may_give_up()) return false;
  if (!is_indefinite_ && !is_clamped_) return false;
  return iterations >= kRestart || (iterations >= kHalvingIterations && left > kHalf);
}

void ContactSolve::apply(const Vector& in, Vector& out) {
  multiply(in, out);
  space_.reduce(out);
  space_.add_slip_stiffness(in, out);
}

KrylovResult ContactSolve::solve(const Vector& r, double tolerance, int max_iters, bool is_guess,
                                 Vector& q) {
  const auto apply = [this](const Vector& in, Vector& out) { this->apply(in, out); };
  return iterate(apply, r, tolerance, max_iters, is_guess, q);
}

void ContactSolve::apply_transposed(const Vector& in, Vector& out) {
  expanded_ = in;
  space_.expand(expanded_);
  multiply(expanded_, out);
  space_.project(out);
  space_.add_slip_stiffness(in, out);
}

KrylovResult ContactSolve::solve_answer(const Vector& x, LinearSide side, const Vector& r,
                                        double tolerance, int max_iters, Vector& out) {
  const auto apply = [&](const Vector& in, Vector& image) {
    side == LinearSide::kTransposed ? apply_transposed(in, image) : this->apply(in, image);
  };
  at_answer_ = true;
  const KrylovResult first = iterate(apply, r, tolerance, max_iters, false, out);
  if (first.converged) return first;
  // Indefinite, or too hard for this preconditioner. That of the clamped tangent is definite.
  problem_.assemble(x, true);
  kind_ = Kind::kTangent;
  if (!preconditioner_.prepare_tangent()) preconditioner_.prepare_base();
  problem_.assemble(x, false);
  const auto precondition = [this](const Vector& in, Vector& z) { this->precondition(in, z); };
  KrylovResult again = flexible_gmres<double>(apply, precondition, r, out, false, tolerance,
                                              max_iters, kRestart, problem_.ops());
  again.num_iters += first.num_iters;
  return again;
}

}  // namespace diffsim
