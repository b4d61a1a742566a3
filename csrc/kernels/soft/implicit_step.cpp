#include "kernels/soft/implicit_step.h"

#include "kernels/soft/descent.h"
#include "kernels/soft/step_search.h"

namespace diffsim {
namespace {

// On the constant factor where a tangent was indefinite, before Newton is tried again. Of 10, 20
// and 40, 40 was fastest on eight steps in which a starfish's arms buckle. Multigrid on the clamped
// tangent is closer to it: with 15 the first step of a twisted beam of contrast 100 takes 27
// iterations, with 40 it takes 46.
constexpr int kFarIterations = 40, kFarIterationsMultigrid = 15;
// A Newton direction's residual need not be lowered below this of the step's tolerance; it is
// lowered to this of the right-hand side at least.
constexpr double kEnoughOfTolerance = 0.5, kLargestForcing = 0.5;
// Steps on an old factor are taken where so many of them are expected to end the search.
constexpr int kMaxOldSteps = 2;
// The last step of iterative solves needs no new tangent where it is expected to end within this of
// the tolerance. The expectation is too high: most of a residual is what solves left. Cantilevers
// of 8,019 and 56,355 DoF need a step more in 1 of 25 at 10, in 7 at 30, in none at 3, which is
// slower.
constexpr double kBeyondTolerance = 10.0;

/// Inexact Newton directions by conjugate gradients on one of three preconditioners.
class Newton {
 public:
  Newton(StepProblem& problem, const SolverPlan& plan, StepMethod method, double rtol)
      : problem_(problem), plan_(plan), method_(method) {
    if (method == StepMethod::kNewtonJacobi) preconditioner_ = Preconditioner::kJacobi;
    if (method == StepMethod::kNewtonCholesky ||
        (method == StepMethod::kAuto && plan.factorize_step(rtol)))
      preconditioner_ = Preconditioner::kTangent;
  }

  /// The direction, solved for as accurately as the step's convergence is worth.
  void direction(const Vector& x, const Vector& gradient, double norm, double tolerance,
                 Vector& d) {
    if (old_factor_suffices(norm, tolerance)) {
      d = gradient;
      for (double& v : d) v = -v;
      problem_.solve_factorized(d, d);
      ++factor_age_;
      on_old_factor_ = true;
      last_norm_ = norm;
      if (problem_.ops().dot(d, gradient) < 0.0) return;
    }
    on_old_factor_ = false;
    // While residuals fall, x moves little: multigrid of the first tangent is as good as a new one.
    if (!old_tangent_suffices(norm, tolerance)) problem_.assemble(x, clamp_, norm < last_norm_);
    const double enough = std::min(kLargestForcing, kEnoughOfTolerance * tolerance / norm);
    const double forcing = std::max(forcing_term(norm, last_norm_), enough);
    last_norm_ = norm;
    Vector rhs = gradient;
    for (double& v : rhs) v = -v;
    if (preconditioner_ == Preconditioner::kTangent) update_factor(x);
    // The Cholesky baseline solves exactly; its factor is always fresh.
    if (method_ == StepMethod::kNewtonCholesky && factor_usable_)
      problem_.solve_factorized(rhs, d);
    else
      iterate(x, rhs, forcing * norm, d);
    if (problem_.ops().dot(d, gradient) < 0.0) return;
    // Not a descent direction: that of the constant system always is one.
    clamp_ = true;
    problem_.precondition(rhs, d);
  }

  bool is_clamped() const { return clamp_; }

  /// Forgets what it knows of where it was.
  void start_again() {
    clamp_ = factor_usable_ = on_old_factor_ = false;
    last_norm_ = 0.0;
  }

 private:
  enum class Preconditioner { kConstant, kJacobi, kTangent };

  /// Whether steps on the factor as it is will do: no new tangent then, which costs as much as
  /// three gradients. A step on an old tangent lowers the residual by its relative error, as the
  /// step before tells: Newton's by half of it, as it was exact where that one began.
  bool old_factor_suffices(double norm, double tolerance) const {
    if (method_ != StepMethod::kAuto || preconditioner_ != Preconditioner::kTangent ||
        !factor_usable_ || clamp_ || !(last_norm_ > 0.0))
      return false;
    const double contraction = (on_old_factor_ ? 1.0 : 2.0) * norm / last_norm_;
    return std::pow(contraction, kMaxOldSteps) * norm <= tolerance;
  }

  /// Whether conjugate gradients on the tangent as it is are expected to end the search.
  bool old_tangent_suffices(double norm, double tolerance) const {
    return problem_.by_multigrid() && preconditioner_ == Preconditioner::kConstant && !clamp_ &&
           last_norm_ > 0.0 && 2.0 * norm / last_norm_ * norm <= kBeyondTolerance * tolerance;
  }

  /// Factorizes the tangent at x where there is no factor yet or the old one has served its time.
  void update_factor(const Vector& x) {
    if (factor_usable_ && method_ == StepMethod::kAuto && factor_age_ < plan_.refactor_after())
      return;
    factor_age_ = 0;
    factor_usable_ = problem_.factorize();
    if (factor_usable_ || clamp_) return;
    clamp_ = true;
    problem_.assemble(x, true);
    factor_usable_ = problem_.factorize();
  }

  void iterate(const Vector& x, const Vector& rhs, double tolerance, Vector& d) {
    KrylovResult result = solve(rhs, tolerance, d);
    if (result.negative_curvature && !clamp_) {
      clamp_ = true;
      problem_.assemble(x, true);
      result = solve(rhs, tolerance, d);
    }
    if (preconditioner_ == Preconditioner::kTangent) factor_age_ += result.num_iters;
    spent_ += result.num_iters;
    if (method_ == StepMethod::kAuto && preconditioner_ == Preconditioner::kConstant &&
        spent_ > plan_.patience(plan_.iteration_cost))
      preconditioner_ = Preconditioner::kTangent;
  }

  KrylovResult solve(const Vector& rhs, double tolerance, Vector& d) {
    const bool tangent = preconditioner_ == Preconditioner::kTangent && factor_usable_;
    const auto apply = [this](const Vector& in, Vector& out) { problem_.multiply(in, out); };
    const auto precondition = [&](const Vector& in, Vector& out) {
      if (tangent)
        problem_.solve_factorized(in, out);
      else if (preconditioner_ == Preconditioner::kJacobi)
        problem_.solve_jacobi(in, out);
      else
        problem_.precondition(in, out);
    };
    return conjugate_gradients(apply, precondition, rhs, d, false, tolerance,
                               static_cast<int>(problem_.size()), krylov_, problem_.ops());
  }

  StepProblem& problem_;
  const SolverPlan& plan_;
  StepMethod method_;
  Preconditioner preconditioner_ = Preconditioner::kConstant;
  bool clamp_ = false, factor_usable_ = false, on_old_factor_ = false;
  int factor_age_ = 0, spent_ = 0;
  double last_norm_ = 0.0;
  KrylovScratch krylov_;
};

/// Moves fixed unknowns from the guess to their targets while free ones follow by the linearized
/// problem, in as many pieces as the energy needs to stay finite. For energies with a barrier:
/// prescribed motion alone may invert the elements beside it. False where no such path is found.
bool follow_targets(StepProblem& problem, const ConstantSystem& system, const StepInputs& inputs,
                    Vector& x) {
  constexpr int kPieces = 30;
  constexpr double kLeastPart = 1.0 / 64.0;  // of what is left of the motion
  constexpr double kAccuracy = 1e-3;         // of the linearized solve, of its right-hand side
  const Vector arrived = x;
  x.assign(inputs.guess, inputs.guess + problem.size());
  KrylovScratch scratch;
  const auto apply = [&](const Vector& in, Vector& out) { problem.multiply(in, out); };
  const auto base = [&](const Vector& in, Vector& out) { problem.precondition(in, out); };
  Vector move, rhs, d, gradient;
  for (int piece = 0; piece < kPieces; ++piece) {
    if (!std::isfinite(problem.value_gradient(x, gradient))) break;
    move.assign(x.size(), 0.0);
    for (std::size_t i = 0; i < x.size(); ++i)
      if (system.fixed()[i]) move[i] = inputs.target[i] - x[i];
    problem.assemble(x, true);
    problem.multiply(move, rhs);
    for (double& v : rhs) v = -v;
    conjugate_gradients(apply, base, rhs, d, false, kAccuracy * problem.ops().norm(rhs),
                        static_cast<int>(x.size()), scratch, problem.ops());
    problem.ops().add(1.0, move, d);
    const Vector start = x;
    for (double part = 1.0; part >= kLeastPart; part *= 0.5) {
      x = start;
      problem.ops().add(part, d, x);
      if (part == 1.0)
        for (std::size_t i = 0; i < x.size(); ++i)
          if (system.fixed()[i]) x[i] = inputs.target[i];
      if (!std::isfinite(problem.value_gradient(x, gradient))) continue;
      if (part == 1.0) return true;
      break;
    }
  }
  x = arrived;
  return false;
}

}  // namespace

StepStats implicit_step(const ConstantSystem& system, const StepInputs& inputs,
                        const StepOptions& options, double* x_out, ThreadPool& pool) {
  StepProblem problem(system, inputs, pool, uses_multigrid(system, options.method));
  Vector x(inputs.guess, inputs.guess + problem.size());
  for (std::size_t i = 0; i < x.size(); ++i)
    if (system.fixed()[i]) x[i] = inputs.target[i];

  Vector gradient, d, x_old, g_old;
  double value = problem.value_gradient(x, gradient);
  if (!std::isfinite(value)) {
    follow_targets(problem, system, inputs, x);
    value = problem.value_gradient(x, gradient);
  }
  const double rounding = system.rounding_floor(x);
  StepStats stats = begin_stats(problem, options, gradient, rounding);
  double best = stats.residual_norm;
  int since_best = 0;

  const StepMethod method = options.method;
  QuasiNewton quasi_newton(problem);
  Newton newton(problem, system.plan(), method, options.rtol);
  // Where the energy is not convex (a body buckles) the clamped tangent makes Newton's steps costly
  // and short, and L-BFGS walks out of it for a fifth of the price. The textbook baselines stay
  // what they are.
  const bool has_recourse = method == StepMethod::kAuto || method == StepMethod::kNewtonPcg;
  int far = 0;
  for (int iter = 0; std::isfinite(value); ++iter) {
    stats.num_iters = iter;
    stats.converged = stats.residual_norm <= stats.tolerance ? 1.0 : 0.0;
    if (stats.converged != 0.0 || iter == options.max_iters) break;
    const bool by_newton = method != StepMethod::kQuasiNewton && far == 0;
    if (by_newton) {
      newton.direction(x, gradient, stats.residual_norm, stats.tolerance, d);
    } else {
      quasi_newton.direction(gradient, d);
      x_old = x;
      g_old = gradient;
    }
    const double slope = problem.ops().dot(d, gradient);
    const bool descended = line_search(problem, d, slope, x, value, gradient);
    stats.residual_norm = problem.ops().norm(gradient);
    since_best = stats.residual_norm < best ? 0 : since_best + 1;
    best = std::min(best, stats.residual_norm);
    // Rounding decides from here on; a tolerance below it is reported as missed, but soon.
    if (best <= rounding && since_best > kMaxStalled && stats.residual_norm > stats.tolerance)
      break;
    if (!by_newton) {
      if (descended)
        quasi_newton.update(x_old, g_old, x, gradient);
      else
        quasi_newton.forget();
      if (far > 0) --far;
    } else if (has_recourse && newton.is_clamped()) {
      newton.start_again();
      quasi_newton.forget();
      far = problem.by_multigrid() ? kFarIterationsMultigrid : kFarIterations;
    } else if (!descended) {
      stats.converged = stats.residual_norm <= stats.tolerance ? 1.0 : 0.0;
      break;
    }
  }
  stats.num_solves = problem.num_solves;
  stats.num_factorizations = problem.num_factorizations;
  stats.energy = problem.elastic_energy();
  std::copy(x.begin(), x.end(), x_out);
  return stats;
}

}  // namespace diffsim
