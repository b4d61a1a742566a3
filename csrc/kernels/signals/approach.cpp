#include "kernels/signals/approach.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels/signals/clipped.h"

namespace diffsim {

namespace {

constexpr int kParts = 16;  // of a step

/// Slopes of a new speed.
struct Slopes {
  double speed, away, most, fastest;
};

/// Place and speed of a point that brakes in time.
struct Point {
  double place, speed;

  void go(double target, double most, double fastest, double h) {
    const double away = target - place, change = most * h;
    speed = clipped(wanted(away, most, fastest, h), speed - change, speed + change);
    place += speed * h;
  }

  /// Slopes of the speed that `go` would give.
  Slopes slopes(double target, double most, double fastest, double h) const {
    const double away = target - place, far = std::abs(away), change = most * h;
    const double aim = wanted(away, most, fastest, h);
    if (aim < speed - change) return {1.0, 0.0, -h, 0.0};
    if (aim > speed + change) return {1.0, 0.0, h, 0.0};
    const double side = std::copysign(1.0, away), root = braking_root(far, most, change);
    if (std::min(root - 0.5 * change, far / h) > fastest) return {0.0, 0.0, 0.0, side};
    if (root - 0.5 * change < far / h)
      return {0.0, most / root, side * ((far + 0.25 * change * h) / root - 0.5 * h), 0.0};
    return {0.0, 1.0 / h, 0.0, 0.0};
  }

 private:
  static double braking_root(double far, double most, double change) {
    return std::sqrt(2.0 * most * far + 0.25 * change * change);
  }
  /// Speed from which it stops at its target in whole parts.
  static double wanted(double away, double most, double fastest, double h) {
    const double far = std::abs(away), change = most * h;
    const double least = std::min(braking_root(far, most, change) - 0.5 * change, far / h);
    return std::copysign(std::min(least, fastest), away);
  }
};

/// One row of points.
struct Row {
  const double* targets;
  double most, fastest;
  bool held;

  Row(const Approach& given, std::int64_t row)
      : targets(given.targets + row * given.num_times),
        most(given.most[row]),
        fastest(given.fastest[row]),
        held(given.held) {}

  Point begin() const { return {targets[0], 0.0}; }
  /// How far part i (1 to kParts) is on its way from one target to the next.
  double share(int i) const { return held ? 0.0 : static_cast<double>(i) / kParts; }
  double target(std::int64_t k, int i) const {
    return targets[k] + share(i) * (targets[k + 1] - targets[k]);
  }
  void go(Point& now, std::int64_t k, double step) const {
    for (int i = 1; i <= kParts; ++i) now.go(target(k, i), most, fastest, step / kParts);
  }
};

}  // namespace

void approach(const Approach& given, double* places) {
  const std::int64_t n = given.num_times;
  for (std::int64_t r = 0; r < given.num_rows; ++r) {
    const Row row(given, r);
    Point now = row.begin();
    places[r * n] = now.place;
    for (std::int64_t k = 0; k < n - 1; ++k) {
      row.go(now, k, given.steps[k]);
      places[r * n + k + 1] = now.place;
    }
  }
}

void approach_vjp(const Approach& given, const double* grad_places, double* grad_targets,
                  double* grad_most, double* grad_fastest) {
  const std::int64_t n = given.num_times;
  std::vector<Point> path(n);
  for (std::int64_t r = 0; r < given.num_rows; ++r) {
    const Row row(given, r);
    path[0] = row.begin();
    for (std::int64_t k = 0; k < n - 1; ++k) row.go(path[k + 1] = path[k], k, given.steps[k]);
    const double* seed = grad_places + r * n;
    double* found = grad_targets + r * n;
    std::fill_n(found, n, 0.0);
    double of_place = 0.0, of_speed = 0.0, of_most = 0.0, of_fastest = 0.0;
    for (std::int64_t k = n - 2; k >= 0; --k) {
      const double h = given.steps[k] / kParts;
      Slopes slopes[kParts];
      Point now = path[k];
      for (int i = 1; i <= kParts; ++i) {
        slopes[i - 1] = now.slopes(row.target(k, i), row.most, row.fastest, h);
        now.go(row.target(k, i), row.most, row.fastest, h);
      }
      of_place += seed[k + 1];
      for (int i = kParts; i >= 1; --i) {
        const Slopes& s = slopes[i - 1];
        const double of_next = of_speed + h * of_place, of_away = of_next * s.away;
        of_speed = of_next * s.speed;
        of_most += of_next * s.most;
        of_fastest += of_next * s.fastest;
        of_place -= of_away;
        found[k] += (1.0 - row.share(i)) * of_away;
        found[k + 1] += row.share(i) * of_away;
      }
    }
    found[0] += of_place + seed[0];
    grad_most[r] = of_most;
    grad_fastest[r] = of_fastest;
  }
}

void approach_tangent(const Approach& given, const double* d_targets, const double* d_most,
                      const double* d_fastest, double* d_places) {
  const std::int64_t n = given.num_times;
  for (std::int64_t r = 0; r < given.num_rows; ++r) {
    const Row row(given, r);
    const double* d_target = d_targets + r * n;
    Point now = row.begin(), moved{d_target[0], 0.0};
    d_places[r * n] = moved.place;
    for (std::int64_t k = 0; k < n - 1; ++k) {
      const double h = given.steps[k] / kParts;
      for (int i = 1; i <= kParts; ++i) {
        const Slopes s = now.slopes(row.target(k, i), row.most, row.fastest, h);
        const double d_away =
            d_target[k] + row.share(i) * (d_target[k + 1] - d_target[k]) - moved.place;
        moved.speed =
            s.speed * moved.speed + s.away * d_away + s.most * d_most[r] + s.fastest * d_fastest[r];
        moved.place += h * moved.speed;
        now.go(row.target(k, i), row.most, row.fastest, h);
      }
      d_places[r * n + k + 1] = moved.place;
    }
  }
}

}  // namespace diffsim
