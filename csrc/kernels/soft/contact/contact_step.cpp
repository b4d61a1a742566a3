#include "kernels/soft/contact/contact_step.h"

#include <limits>

#include "kernels/soft/contact/contact_relaxation.h"
#include "kernels/soft/contact/contact_solve.h"
#include "kernels/soft/contact/contact_status.h"

namespace diffsim {
namespace {

class ContactNewton {
 public:
  ContactNewton(const ConstantSystem& system, const StepInputs& inputs,
                const ContactInputs& contacts, const StepOptions& options,
                const ContactOptions& contact_options, ThreadPool& pool)
      : system_(system),
        in_(inputs),
        options_(options),
        problem_(system, inputs, pool),
        space_(contacts),
        statuses_(space_, system.diagonal()),
        solve_(problem_, system, space_, options.method, options.rtol,
               contact_options.cache_columns, pool) {}

  StepStats run(double* x_out, double* force, std::int64_t* status) {
    start();
    StepStats stats;
    stats.scale = problem_.scale() > 0.0 ? problem_.scale() : problem_.ops().norm(gradient_);
    stats.tolerance = options_.rtol * stats.scale + options_.atol;
    tolerance_ = stats.tolerance;
    statuses_.set_tolerances(stats.tolerance, 1e-12 * radius());
    guess_statuses();
    bool moved = false;  // whether x satisfies the constraints of the statuses as they are
    for (int iter = 0; std::isfinite(value_); ++iter) {
      const bool changed = iter > 0 && statuses_.update(x_, gradient_);
      if (changed) {
        moved = false;
        solve_.statuses_changed();
      }
      if (iter < options_.max_iters && statuses_.needs_resolution() && relax()) {
        moved = false;
        continue;
      }
      statuses_.update_slip(x_, gradient_);
      Vector residual = gradient_;
      space_.reduce(residual);
      stats.residual_norm = problem_.ops().norm(residual);
      stats.num_iters = iter;
      stats.converged = moved && stats.residual_norm <= tolerance_ ? 1.0 : 0.0;
      if (stats.converged != 0.0 || iter == options_.max_iters) break;
      const bool descended = newton_step(stats.residual_norm);
      stalled_ =
          moved && (!descended || !improves(stats.residual_norm, changed)) ? stalled_ + 1 : 0;
      moved = true;
      if (stalled_ > (descended ? kMaxStalled : 5)) {  // rounding decides from here on
        stats.num_iters = iter + 1;
        break;
      }
    }
    if (!std::isfinite(value_)) stats.residual_norm = value_;
    finish(stats, x_out, force, status);
    return stats;
  }

 private:
  /// Whether the residual is the least with these statuses, or above what rounding leaves of it.
  bool improves(double residual_norm, bool changed) {
    const bool better =
        changed || residual_norm > system_.rounding_floor(x_) || residual_norm < 0.99 * least_norm_;
    if (better) least_norm_ = residual_norm;
    return better;
  }

  /// Starts from the guess or from the inertial positions y, whichever has less energy.
  void start() {
    const Vector guess = with_targets(in_.guess);
    x_ = with_targets(in_.y);
    double inertial = 0.0, work = 0.0;
    for (std::size_t i = 0; i < guess.size(); ++i) {
      if (system_.fixed()[i]) continue;
      const double d = guess[i] - in_.y[i];
      inertial += 0.5 * system_.inertia()[i / 3] * d * d;
      work += in_.force[i] * d;
    }
    if (inertial > 0.0) {
      value_ = problem_.value_gradient(x_, gradient_);
      // Elastic energy is not negative: the guess has at least this much.
      if (value_ <= inertial - work) return;
    }
    Vector gradient;
    const double value = problem_.value_gradient(guess, gradient);
    if (inertial > 0.0 && (value_ <= value || !std::isfinite(value))) return;
    x_ = guess;
    value_ = value;
    gradient_ = gradient;
  }

  Vector with_targets(const double* positions) const {
    Vector x(positions, positions + problem_.size());
    for (std::size_t i = 0; i < x.size(); ++i)
      if (system_.fixed()[i]) x[i] = in_.target[i];
    return x;
  }

  /// Half the body's extent: the length that rounding is measured by.
  double radius() const {
    double low[3] = {1e300, 1e300, 1e300}, high[3] = {-1e300, -1e300, -1e300}, largest = 0.0;
    for (std::size_t i = 0; i < x_.size(); ++i) {
      low[i % 3] = std::min(low[i % 3], x_[i]);
      high[i % 3] = std::max(high[i % 3], x_[i]);
      largest = std::max(largest, std::abs(x_[i]));
    }
    double extent = 0.0;
    for (int a = 0; a < 3; ++a) extent = std::max(extent, 0.5 * (high[a] - low[a]));
    return std::max(extent, 1e-3 * largest);
  }

  void guess_statuses() {
    Vector free(in_.y, in_.y + x_.size());
    for (std::size_t i = 0; i < free.size(); ++i) {
      const double inertia = system_.inertia()[i / 3];
      if (inertia > 0.0) free[i] += in_.force[i] / inertia;
    }
    statuses_.guess(free);
    statuses_.remember();
  }

  /// Statuses cycle: solve the linearised contact problem as a whole.
  bool relax() {
    std::vector<std::size_t> near;
    for (std::size_t k = 0; k < space_.size(); ++k)
      if (touched_[k] || space_.status[k] != ContactStatus::kSeparate || space_.gap(k, x_) < 0.0)
        near.push_back(k);
    // Infinite friction may leave no answer to relax to; see kMaxReleases.
    const auto sticky = [&](std::size_t k) { return std::isinf(space_.inputs().friction[k]); };
    if (near.size() > kMaxRelaxed || std::any_of(near.begin(), near.end(), sticky)) return false;
    // Each time round, more linearisations before Newton takes over again.
    const int rounds = 1 << std::min(num_relaxed_, kMaxDoublings);
    num_relaxed_ += 2;
    for (int round = 0; round < rounds; ++round) {
      const std::vector<ContactStatus> before = space_.status;
      Vector step = x_, limits;
      if (!relax_contacts(problem_, space_, near, gradient_, step, limits)) return round > 0;
      problem_.ops().add(-1.0, x_, step);
      take_relaxed(step, limits, round > 0);
      if (round > 0 && space_.status == before) break;
    }
    solve_.statuses_changed();
    return true;
  }

  /// Moves x along `step` as far as lowers the merit (the first step only has to reach the half
  /// spaces, which later ones do not leave: these are convex).
  void take_relaxed(const Vector& step, const Vector& limits, bool search) {
    const Vector start = x_;
    const double before = merit(x_, value_, limits);
    for (double length = 1.0; length > 1e-3; length *= 0.5) {
      x_ = start;
      problem_.ops().add(length, step, x_);
      value_ = problem_.value_gradient(x_, gradient_);
      if (std::isfinite(value_) && (!search || merit(x_, value_, limits) <= before)) return;
    }
  }

  /// Solves for the free unknowns and moves x; false where no step lowers the merit.
  bool newton_step(double residual_norm) {
    for (std::size_t k = 0; k < space_.size(); ++k)
      if (space_.status[k] != ContactStatus::kSeparate) touched_[k] = true;
    problem_.assemble(x_, clamp_);
    solve_.matrix_changed();
    const double forcing = forcing_term(residual_norm);
    const Search found = search(forcing, 0.3 * tolerance_);
    if (found != Search::kAscends) return found == Search::kDescended;
    // GMRES, unlike conjugate gradients, may stop at a direction that leads up: on a stiff body a
    // small residual leaves rigid motion open. Solved to its digits it leads down.
    return search(kTightForcing, 0.0) == Search::kDescended;
  }

  enum class Search { kDescended, kFailed, kAscends };

  /// Newton's direction on the statuses as they are: onto the constraints, then within them.
  /// Friction that would push a node backwards stops it instead.
  /// @param[in] forcing, floor  accuracy of the linear solve: relative, and what is enough [N]
  /// Returns the norm of what is left to solve on them [N].
  double direction(double forcing, double floor, Vector& onto, Vector& q) {
    double size = 0.0;
    for (int trial = 0; trial < 5; ++trial) {
      size = direction_on_statuses(forcing, floor, onto, q);
      if (!statuses_.stop_reversed(x_, q)) break;
      solve_.statuses_changed();
    }
    return size;
  }

  double direction_on_statuses(double forcing, double floor, Vector& onto, Vector& q) {
    Vector rhs;
    space_.correction(x_, onto);
    problem_.multiply(onto, rhs);
    for (std::size_t i = 0; i < rhs.size(); ++i) rhs[i] = -(rhs[i] + gradient_[i]);
    space_.reduce(rhs);
    const double size = problem_.ops().norm(rhs);
    solve_linear(rhs, std::max(forcing * size, std::min(0.5 * size, floor)), q);
    return size;
  }

  /// Relative accuracy of the linear solve (Eisenstat and Walker 1996, choice 2).
  double forcing_term(double residual_norm) {
    double forcing = 0.1;
    if (last_norm_ > 0.0) {
      const double ratio = residual_norm / last_norm_;
      forcing = std::min(0.1, 0.9 * ratio * ratio);
    }
    last_norm_ = residual_norm;
    return forcing;
  }

  void solve_linear(const Vector& rhs, double tolerance, Vector& q) {
    const int limit = static_cast<int>(std::min<std::size_t>(problem_.size(), 2000));
    KrylovResult result = solve_.solve(rhs, tolerance, limit, q);
    if (result.negative_curvature && !clamp_) {
      clamp_ = true;
      problem_.assemble(x_, true);
      solve_.matrix_changed();
      result = solve_.solve(rhs, tolerance, limit, q);
    }
    if (!result.converged && options_.method == StepMethod::kAuto) {
      solve_.use_tangent();
      solve_.statuses_changed();
      solve_.solve(rhs, tolerance, limit, q);
    }
  }

  /// g plus what friction would dissipate if the normal forces were those predicted (Tresca): its
  /// minimum on the constraints is where the Newton step goes.
  double merit(const Vector& x, double value, const Vector& limits) const {
    double u[3];
    for (std::size_t k = 0; k < space_.size(); ++k)
      if (limits[k] > 0.0) value += limits[k] * space_.slip(k, x, u);
    return value;
  }

  Vector friction_limits(const Vector& onto, const Vector& q) {
    Vector limits(space_.size(), 0.0), step = onto, change;
    if (!space_.any_sliding_friction()) return limits;
    problem_.ops().add(1.0, q, step);
    problem_.multiply(step, change);
    for (std::size_t k = 0; k < space_.size(); ++k)
      if (space_.status[k] == ContactStatus::kSlip)
        limits[k] = space_.inputs().friction[k] *
                    std::max(0.0, space_.normal_part(k, gradient_) + space_.normal_part(k, change));
    return limits;
  }

  /// Moves x along Newton's direction; leaves it where that direction ascends for want of digits.
  Search search(double forcing, double floor) {
    Vector onto, q;
    const double rhs_norm = direction(forcing, floor, onto, q);
    const bool corrected = std::any_of(onto.begin(), onto.end(), [](double v) { return v != 0.0; });
    const Vector limits = friction_limits(onto, q);
    Vector start = x_;
    if (corrected) {
      problem_.ops().add(1.0, onto, start);
      // Most often the whole step is good: then nothing need be known of where it starts.
      if (!clamp_ && !space_.any_sliding_friction()) {
        x_ = start;
        problem_.ops().add(1.0, q, x_);
        value_ = problem_.value_gradient(x_, gradient_);
        Vector residual = gradient_;
        space_.reduce(residual);
        if (std::isfinite(value_) && problem_.ops().norm(residual) <= 0.3 * rhs_norm)
          return Search::kDescended;
      }
      value_ = problem_.value_gradient(start, gradient_);
    }
    const double before = merit(start, value_, limits);
    const double slope = merit_slope(q, limits);
    if (slope > 0.0 && forcing > kTightForcing && space_.any_sliding_friction()) {
      if (corrected) value_ = problem_.value_gradient(x_, gradient_);
      return Search::kAscends;
    }
    const double rounding = 1e-14 * problem_.magnitude();
    for (double step = 1.0; step > 1e-9; step *= 0.5) {
      x_ = start;
      problem_.ops().add(step, q, x_);
      value_ = problem_.value_gradient(x_, gradient_);
      const double after = merit(x_, value_, limits);
      if (!std::isfinite(after)) continue;
      if (after <= before + 1e-4 * step * std::min(slope, 0.0) + rounding)
        return Search::kDescended;
      // Near the answer the energy has no digits left, but its slope has.
      if (after <= before + 1e-6 * problem_.magnitude() &&
          std::abs(merit_slope(q, limits)) <= 0.9 * std::abs(slope))
        return Search::kDescended;
    }
    // No descent: the statuses are not those of an answer. A whole step changes them.
    x_ = start;
    if (clamp_) problem_.ops().add(1.0, q, x_);
    value_ = problem_.value_gradient(x_, gradient_);
    if (!std::isfinite(value_)) {
      x_ = start;
      value_ = problem_.value_gradient(x_, gradient_);
    }
    clamp_ = true;
    return Search::kFailed;
  }

  double merit_slope(const Vector& q, const Vector& limits) {
    double slope = problem_.ops().dot(gradient_, q);
    for (std::size_t k = 0; k < space_.size(); ++k)
      for (std::size_t i = 0; limits[k] > 0.0 && i < 3; ++i)
        slope += limits[k] * space_.direction[3 * k + i] * q[3 * space_.node(k) + i];
    return slope;
  }

  void finish(StepStats& stats, double* x_out, double* force, std::int64_t* status) {
    stats.num_solves = problem_.num_solves;
    stats.num_factorizations = problem_.num_factorizations;
    stats.energy = problem_.elastic_energy();
    stats.num_set_changes = statuses_.num_changes();
    stats.num_cycles = statuses_.num_cycles();
    for (std::size_t k = 0; k < space_.size(); ++k) {
      const ContactStatus s = space_.status[k];
      status[k] = static_cast<std::int64_t>(s);
      stats.num_contacts += s != ContactStatus::kSeparate;
      stats.num_slipping += s == ContactStatus::kSlip;
      for (std::size_t i = 0; i < 3; ++i)
        force[3 * k + i] = s == ContactStatus::kSeparate ? 0.0 : gradient_[3 * space_.node(k) + i];
    }
    std::copy(x_.begin(), x_.end(), x_out);
  }

  // The dense operator of the fallback has (3 k)^2 entries.
  static constexpr std::size_t kMaxRelaxed = 1500;
  static constexpr double kTightForcing = 1e-9;
  static constexpr int kMaxStalled = 20;
  static constexpr int kMaxDoublings = 5;
  const ConstantSystem& system_;
  const StepInputs& in_;
  const StepOptions& options_;
  StepProblem problem_;
  ContactSpace space_;
  ContactStatuses statuses_;
  ContactSolve solve_;
  Vector x_, gradient_;
  std::vector<bool> touched_ = std::vector<bool>(space_.size(), false);
  double value_ = 0.0, tolerance_ = 0.0, last_norm_ = 0.0;
  double least_norm_ = std::numeric_limits<double>::infinity();
  bool clamp_ = false;
  int stalled_ = 0, num_relaxed_ = 0;
};

}  // namespace

StepStats contact_step(const ConstantSystem& system, const StepInputs& inputs,
                       const ContactInputs& contacts, const StepOptions& options,
                       const ContactOptions& contact_options, double* x, double* force,
                       std::int64_t* status, ThreadPool& pool) {
  return ContactNewton(system, inputs, contacts, options, contact_options, pool)
      .run(x, force, status);
}

}  // namespace diffsim
