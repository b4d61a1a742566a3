#include "kernels/soft/contact/contact_step.h"

#include <limits>

#include "kernels/soft/contact/contact_direction.h"
#include "kernels/soft/contact/contact_relaxation.h"
#include "kernels/soft/contact/contact_search.h"
#include "kernels/soft/contact/contact_start.h"
#include "kernels/soft/descent.h"
#include "kernels/soft/step_search.h"

namespace diffsim {
namespace {

// Residual of a linear system that is enough, of the step's tolerance; on multigrid, and the
// largest of its right-hand side there. A tolerance of M/dt^2 times the body's extent lets forces
// be wrong by as much as weight is at short steps. Cholesky leaves a tenth of it, and the constant
// factor has no error of rigid motion. A Newton step on multigrid costs a set-up, as much as 8
// iterations: what Newton leaves should decide when it ends, not what the linear solve leaves.
// Not where statuses change: they change again, and what a loose solve leaves is less than that.
constexpr double kEnoughOfTolerance = 0.3, kEnoughOnMultigrid = 0.01, kMultigridForcing = 1e-3;
constexpr double kChangingForcing = 0.03;
// A direction solved to its digits. GMRES, unlike conjugate gradients, may stop at one that leads
// up: on a stiff body a small residual leaves rigid motion open. At this accuracy it leads down.
constexpr double kTightForcing = 1e-9;
// A step's first contacts that the linearized problem lets go, of all, from which on it is asked
// whether they turn elements inside out, and how often it is solved on fewer. A ball that sinks in
// by a cell has 200 at first, then 98, 58 and 43; its answer has 26.
constexpr double kManyLetGo = 0.2;
constexpr int kFirstSets = 4;
// Iterations in a row after which rounding decides, where no direction descends; where they do,
// kMaxStalled. The residual progresses where it falls below this of its least.
constexpr int kMaxFailed = 5;
constexpr double kProgress = 0.99;
// Decrease of the residual in a step on a clamped H that is worth another: where it is definite the
// steps are Newton's, near an answer where it is not they are far shorter.
constexpr double kClampedDecrease = 0.5;

/// How long the iteration has made no progress.
struct Stall {
  int count = 0;
  double least_norm = std::numeric_limits<double>::infinity();  // of the residual [N]
};

/// After an iteration that began with residual `norm` on the constraints of its statuses.
Stall after_iteration(const Stall& before, double norm, bool descended, bool statuses_changed,
                      const ConstantSystem& system, const Vector& x) {
  if (!descended) return {before.count + 1, before.least_norm};
  // Above what rounding leaves of the residual it may rise and fall, and still converge later; the
  // very same one is of steps that were too short to move x.
  const bool moves = norm > system.rounding_floor(x) && norm != before.least_norm;
  const bool better = statuses_changed || moves || norm < kProgress * before.least_norm;
  return better ? Stall{0, norm} : Stall{before.count + 1, before.least_norm};
}

/// Whether the end of a direction has more energy than where the body was.
bool is_beyond_guess(ContactProblem& p, const Vector& end) {
  Vector unused;
  const Vector guess(p.inputs.guess, p.inputs.guess + end.size());
  return !(p.objective.value_gradient(end, unused) <= p.objective.value_gradient(guess, unused));
}

/// Newton's direction from the start of a step. Where it would crush the body, the contacts take
/// the statuses that the linearized problem gives them: most of all it lets many go.
ContactDirection first_direction(ContactProblem& p, const ContactIterate& at,
                                 const DirectionAccuracy& accuracy, bool is_clamped) {
  ContactDirection d = contact_direction(p, at, accuracy, ContactDirection::none(is_clamped));
  const DirectionAccuracy loose{std::max(accuracy.forcing, kChangingForcing), accuracy.enough};
  VectorOps& ops = p.objective.ops();
  Vector force;
  for (int set = 1; set < kFirstSets; ++set) {
    Vector step = d.onto, end = at.x;
    ops.add(1.0, d.within, step);
    p.objective.multiply(step, force);
    ops.add(1.0, at.gradient, force);
    ops.add(1.0, step, end);
    const double many = kManyLetGo * static_cast<double>(p.space.num_contacts());
    if (static_cast<double>(p.statuses.num_let_go(end, force)) <= many || !is_beyond_guess(p, end))
      break;
    p.statuses.update(end, force);
    p.statuses.update_slip(at.x, at.gradient);
    p.solve.statuses_changed();
    d = contact_direction(p, at, loose, std::move(d));
  }
  p.statuses.begin();
  return d;
}

/// What one Newton step did.
struct NewtonStep {
  bool descended;    // the merit
  bool was_clamped;  // H
  bool clamps_next;  // whether H is to be positive definite from here on
};

/// Solves for the free unknowns and moves x.
/// @param forcing    residual of the linear system, of its right-hand side, on a factor
/// @param changed    the statuses, since the last step
/// @param tolerance  of the whole step [N]
/// @param is_first   whether the step begins here
NewtonStep newton_step(ContactProblem& p, double forcing, bool changed, double tolerance,
                       bool is_clamped, bool is_first, ContactIterate& at) {
  p.objective.assemble(at.x, is_clamped);
  p.solve.matrix_changed(is_clamped);
  const bool on_multigrid = p.solve.on_multigrid();
  const double enough = on_multigrid ? kEnoughOnMultigrid : kEnoughOfTolerance;
  if (on_multigrid) forcing = std::min(forcing, changed ? kChangingForcing : kMultigridForcing);
  const DirectionAccuracy accuracy{forcing, enough * tolerance};
  const ContactDirection loose =
      is_first ? first_direction(p, at, accuracy, is_clamped)
               : contact_direction(p, at, accuracy, ContactDirection::none(is_clamped));
  const SearchResult first = search_along(p, loose, forcing > kTightForcing, at);
  if (first != SearchResult::kAscends)
    return {first == SearchResult::kDescended, loose.is_clamped,
            loose.is_clamped || first == SearchResult::kFailed};
  const ContactDirection tight =
      contact_direction(p, at, {kTightForcing, 0.0}, ContactDirection::none(loose.is_clamped));
  const SearchResult second = search_along(p, tight, false, at);
  return {second == SearchResult::kDescended, tight.is_clamped,
          tight.is_clamped || second == SearchResult::kFailed};
}

/// Semismooth Newton iteration from x to where `stats` says that it came.
void iterate(ContactProblem& p, ContactIterate& at, StepStats& stats) {
  ContactRelaxation relaxation(p.space.size());
  Stall stall;
  bool is_clamped = false, was_clamped = false;
  bool on_constraints = false;  // whether x satisfies those of the statuses as they are
  double last_norm = 0.0;
  for (int iter = 0; std::isfinite(at.value); ++iter) {
    const bool changed = iter > 0 && p.statuses.update(at.x, at.gradient);
    if (changed) {
      on_constraints = false;
      p.solve.statuses_changed();
    }
    // A Newton step on a factor serves one set of statuses, a relaxation all of them.
    const bool cycled = p.statuses.needs_resolution();
    const bool needs_all = cycled || (changed && p.solve.factors_each_set());
    if (iter < p.options.max_iters && needs_all && relaxation.resolve(p, cycled, at)) {
      on_constraints = false;
      continue;
    }
    p.statuses.update_slip(at.x, at.gradient);
    stats.residual_norm = p.reduced_norm(at.gradient);
    stats.num_iters = iter;
    stats.converged = on_constraints && stats.residual_norm <= stats.tolerance ? 1.0 : 0.0;
    if (stats.converged != 0.0 || iter == p.options.max_iters) break;
    relaxation.remember(p.space);
    const double forcing = forcing_term(stats.residual_norm, last_norm);
    if (was_clamped && stats.residual_norm > kClampedDecrease * last_norm) is_clamped = false;
    const NewtonStep step =
        newton_step(p, forcing, changed, stats.tolerance, is_clamped, iter == 0, at);
    last_norm = stats.residual_norm;
    is_clamped = step.clamps_next;
    was_clamped = step.was_clamped;
    stall = on_constraints ? after_iteration(stall, stats.residual_norm, step.descended, changed,
                                             p.system, at.x)
                           : Stall{0, stall.least_norm};
    on_constraints = true;
    if (stall.count > (step.descended ? kMaxStalled : kMaxFailed)) {
      stats.num_iters = iter + 1;
      break;
    }
  }
  if (!std::isfinite(at.value)) stats.residual_norm = at.value;
}

void count_contacts(const ContactSpace& space, StepStats& stats) {
  for (const ContactStatus s : space.status) {
    stats.num_contacts += s != ContactStatus::kSeparate;
    stats.num_slipping += s == ContactStatus::kSlip;
  }
}

/// Contact forces r = grad g and statuses at the answer.
void write_contacts(const ContactSpace& space, const Vector& gradient, double* force,
                    std::int64_t* status) {
  for (std::size_t k = 0; k < space.size(); ++k) {
    const bool touches = space.status[k] != ContactStatus::kSeparate;
    status[k] = static_cast<std::int64_t>(space.status[k]);
    for (std::size_t i = 0; i < 3; ++i)
      force[3 * k + i] = touches ? gradient[3 * space.node(k) + i] : 0.0;
  }
}

}  // namespace

StepStats contact_step(const ConstantSystem& system, const StepInputs& inputs,
                       const ContactInputs& contacts, const StepOptions& options,
                       const ContactOptions& contact_options, double* x, double* force,
                       std::int64_t* status, ThreadPool& pool) {
  ContactProblem problem(system, inputs, contacts, options, contact_options, pool);
  StepProblem& objective = problem.objective;
  ContactIterate at = contact_start(problem);
  StepStats stats = begin_stats(objective, options, at.gradient, system.rounding_floor(at.x));
  problem.statuses.set_tolerances(stats.tolerance, length_tolerance(at.x));
  problem.statuses.begin();
  iterate(problem, at, stats);
  stats.num_solves = objective.num_solves;
  stats.num_factorizations = objective.num_factorizations;
  stats.energy = objective.elastic_energy();
  stats.num_set_changes = problem.statuses.num_changes();
  stats.num_cycles = problem.statuses.num_cycles();
  count_contacts(problem.space, stats);
  write_contacts(problem.space, at.gradient, force, status);
  std::copy(at.x.begin(), at.x.end(), x);
  return stats;
}

}  // namespace diffsim
