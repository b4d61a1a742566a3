// What goes to a target with its acceleration limited; see follow.h.
#include <cmath>
#include <vector>

#include "kernels/signals/clipped.h"
#include "kernels/signals/follow.h"

namespace diffsim {

namespace {

/// What does not change along a row.
struct Limits {
  double most, fastest;
};

/// A small step of a row, towards where the target is at its end.
struct Part {
  Limits limits;
  double h;

  double change() const { return limits.most * h; }
  /// Speed from which it stops in whole parts times a share of `change`, and that.
  double root(double away) const {
    return std::sqrt(2.0 * limits.most * std::abs(away) + 0.25 * change() * change());
  }
  bool arrives(double away) const { return std::abs(away) / h <= root(away) - 0.5 * change(); }
  /// Speed that brings it there as soon as it may, were there no limits.
  double wish(double away) const {
    return arrives(away) ? away / h : std::copysign(root(away) - 0.5 * change(), away);
  }
  double wanted(double away) const { return clipped(wish(away), -limits.fastest, limits.fastest); }
};

/// Place and speed, or their slopes.
struct Point {
  double place, speed;

  void go(const Part& part, double target) {
    const double change = part.change();
    speed = clipped(part.wanted(target - place), speed - change, speed + change);
    place += speed * part.h;
  }
};

/// Slopes of the speed after a part; the place moves by h times it.
struct Slopes {
  double away, speed, most, fastest;

  Slopes(const Part& part, const Point& before, double target) {
    const double gap = target - before.place, change = part.change(), fast = part.limits.fastest;
    const Shares kept = shares(part.wanted(gap), before.speed - change, before.speed + change);
    const Shares wish = shares(part.wish(gap), -fast, fast);
    const double by_wish = kept.value * wish.value;
    speed = kept.low + kept.high;
    fastest = kept.value * (wish.high - wish.low);
    most = (kept.high - kept.low) * part.h;
    if (part.arrives(gap)) {
      away = by_wish / part.h;
    } else {
      const double root = part.root(gap), by_change = 0.25 * change / root - 0.5;
      away = by_wish * part.limits.most / root;
      most += std::copysign(by_wish, gap) * (std::abs(gap) / root + by_change * part.h);
    }
  }
};

/// One row: where its target is, and the parts of its steps.
class Row {
 public:
  Row(const Approach& a, std::int64_t row)
      : a_(a), targets_(a.targets + row * a.num_times), limits_{a.most[row], a.fastest[row]} {}

  std::int64_t num_steps() const { return a_.num_times - 1; }
  Point start() const { return {targets_[0], 0.0}; }
  Part part(std::int64_t k) const { return {limits_, a_.steps[k] / kParts}; }
  /// How much of the next target there is in that of part i, 1 to kParts.
  double share(int i) const { return a_.held ? 0.0 : static_cast<double>(i) / kParts; }
  double target(std::int64_t k, int i) const {
    return targets_[k] + share(i) * (targets_[k + 1] - targets_[k]);
  }

 private:
  const Approach& a_;
  const double* targets_;
  const Limits limits_;
};

void pull(const Row& row, const double* grad_places, double* grad_targets, double* grad_most,
          double* grad_fastest) {
  const std::int64_t num_steps = row.num_steps();
  std::vector<Point> before(kParts * num_steps);
  Point now = row.start();
  for (std::int64_t k = 0; k < num_steps; ++k) {
    for (int i = 1; i <= kParts; ++i) {
      before[k * kParts + i - 1] = now;
      now.go(row.part(k), row.target(k, i));
    }
  }
  Point grad{0.0, 0.0};
  for (std::int64_t k = num_steps - 1; k >= 0; --k) {
    grad.place += grad_places[k + 1];
    const Part part = row.part(k);
    for (int i = kParts; i > 0; --i) {
      const Slopes slopes(part, before[k * kParts + i - 1], row.target(k, i));
      const double of_speed = grad.speed + grad.place * part.h;
      const double of_target = slopes.away * of_speed;
      grad_targets[k] += (1.0 - row.share(i)) * of_target;
      grad_targets[k + 1] += row.share(i) * of_target;
      *grad_most += slopes.most * of_speed;
      *grad_fastest += slopes.fastest * of_speed;
      grad.place -= of_target;
      grad.speed = slopes.speed * of_speed;
    }
  }
  grad_targets[0] += grad.place + grad_places[0];
}

void push(const Row& row, const double* d_targets, double d_most, double d_fastest,
          double* d_places) {
  Point now = row.start(), moved{d_targets[0], 0.0};
  d_places[0] = moved.place;
  for (std::int64_t k = 0; k < row.num_steps(); ++k) {
    const Part part = row.part(k);
    for (int i = 1; i <= kParts; ++i) {
      const Slopes slopes(part, now, row.target(k, i));
      const double d_target = d_targets[k] + row.share(i) * (d_targets[k + 1] - d_targets[k]);
      moved.speed = slopes.away * (d_target - moved.place) + slopes.speed * moved.speed +
                    slopes.most * d_most + slopes.fastest * d_fastest;
      moved.place += moved.speed * part.h;
      now.go(part, row.target(k, i));
    }
    d_places[k + 1] = moved.place;
  }
}

}  // namespace

void approach(const Approach& a, double* places) {
  for (std::int64_t r = 0; r < a.num_rows; ++r) {
    const Row row(a, r);
    Point now = row.start();
    double* const y = places + r * a.num_times;
    y[0] = now.place;
    for (std::int64_t k = 0; k < row.num_steps(); ++k) {
      for (int i = 1; i <= kParts; ++i) now.go(row.part(k), row.target(k, i));
      y[k + 1] = now.place;
    }
  }
}

void approach_vjp(const Approach& a, const double* grad_places, double* grad_targets,
                  double* grad_most, double* grad_fastest) {
  for (std::int64_t r = 0; r < a.num_rows; ++r) {
    const std::int64_t at = r * a.num_times;
    pull(Row(a, r), grad_places + at, grad_targets + at, grad_most + r, grad_fastest + r);
  }
}

void approach_tangent(const Approach& a, const double* d_targets, const double* d_most,
                      const double* d_fastest, double* d_places) {
  for (std::int64_t r = 0; r < a.num_rows; ++r) {
    const std::int64_t at = r * a.num_times;
    push(Row(a, r), d_targets + at, d_most[r], d_fastest[r], d_places + at);
  }
}

}  // namespace diffsim
