#include "kernels/signals/follow.h"

#include <algorithm>
#include <cmath>
#include <vector>

namespace diffsim {

namespace {

/// numpy's minimum of a maximum: a bound that is not a number is the answer.
inline double clipped(double value, double low, double high) {
  const double sum = low + high;
  if (std::isnan(sum)) return sum;
  return std::min(std::max(value, low), high);
}

template <Follow how>
void follow_row(std::int64_t num_times, const double* targets, const double* room,
                std::int64_t room_step, double* out) {
  double now = out[0];
  for (std::int64_t k = 1; k < num_times; ++k) {
    const double width = room[(k - 1) * room_step];
    const double target = targets[k];
    now = how == Follow::play ? clipped(now, target - width, target + width)
                              : clipped(target, now - width, now + width);
    out[k] = now;
  }
}

constexpr int kParts = 16;  // of a step

/// Place and speed of a point that brakes in time.
struct Point {
  double place, speed;

  void go(double target, double most, double fastest, double h) {
    const double away = target - place, change = most * h;
    // speed from which it stops there in whole parts
    const double root = std::sqrt(2.0 * most * std::abs(away) + 0.25 * change * change);
    const double least = std::min(root - 0.5 * change, std::abs(away) / h);
    const double wanted = std::copysign(std::min(least, fastest), away);
    speed = clipped(wanted, speed - change, speed + change);
    place += speed * h;
  }
};

/// Targets of the parts of a step.
struct Course {
  double start, way;

  Course(const double* u, bool held) : start(u[0]), way(held ? 0.0 : u[1] - u[0]) {}
  static double share(int part) { return static_cast<double>(part) / kParts; }
  double target(int part) const { return start + share(part) * way; }
};

/// Slopes of a sum to a point, and to the limits that it keeps.
struct Slopes {
  double place = 0.0, speed = 0.0, most = 0.0, fastest = 0.0;

  /// Back through `Point::go` from `before`; returns the slope to the target.
  double go_back(const Point& before, double target, double limit, double top, double h) {
    const double away = target - before.place, size = std::abs(away), change = limit * h;
    const double root = std::sqrt(2.0 * limit * size + 0.25 * change * change);
    const double brakes = root - 0.5 * change, arrives = size / h;
    const double least = std::min(std::min(brakes, arrives), top);
    const double wanted = std::copysign(least, away);
    const double of_speed = speed + place * h;
    double of_change = 0.0, of_size = 0.0;
    speed = 0.0;
    if (std::abs(wanted - before.speed) > change) {
      speed = of_speed;
      of_change = wanted > before.speed ? of_speed : -of_speed;
    } else if (away != 0.0) {
      const double of_least = std::copysign(1.0, away) * of_speed;
      if (top < std::min(brakes, arrives)) {
        fastest += of_least;
      } else if (arrives < brakes) {
        of_size = of_least / h;
      } else {
        of_size = of_least * limit / root;
        most += of_least * size / root;
        of_change = of_least * (0.25 * change / root - 0.5);
      }
    }
    most += of_change * h;
    const double of_target = away < 0.0 ? -of_size : of_size;
    place -= of_target;
    return of_target;
  }
};

}  // namespace

void approach(std::int64_t num_rows, std::int64_t num_times, const double* targets,
              const double* steps, const double* most, const double* fastest, bool held,
              double* out) {
  for (std::int64_t row = 0; row < num_rows; ++row) {
    const double* const u = targets + row * num_times;
    double* const y = out + row * num_times;
    Point now{u[0], 0.0};
    y[0] = u[0];
    for (std::int64_t k = 0; k < num_times - 1; ++k) {
      const double h = steps[k] / kParts;
      const Course course(u + k, held);
      for (int i = 1; i <= kParts; ++i) now.go(course.target(i), most[row], fastest[row], h);
      y[k + 1] = now.place;
    }
  }
}

void approach_adjoint(std::int64_t num_rows, std::int64_t num_times, const double* targets,
                      const double* steps, const double* most, const double* fastest, bool held,
                      const double* slope, double* of_targets, double* of_most,
                      double* of_fastest) {
  std::vector<Point> way(static_cast<std::size_t>((num_times - 1) * kParts + 1));
  for (std::int64_t row = 0; row < num_rows; ++row) {
    const double* const u = targets + row * num_times;
    double* const of_u = of_targets + row * num_times;
    way[0] = {u[0], 0.0};
    Point* now = way.data();
    for (std::int64_t k = 0; k < num_times - 1; ++k) {
      const Course course(u + k, held);
      for (int i = 1; i <= kParts; ++i, ++now) {
        now[1] = now[0];
        now[1].go(course.target(i), most[row], fastest[row], steps[k] / kParts);
      }
    }
    Slopes slopes;
    std::fill(of_u, of_u + num_times, 0.0);
    for (std::int64_t k = num_times - 2; k >= 0; --k) {
      const Course course(u + k, held);
      slopes.place += slope[row * num_times + k + 1];
      for (int i = kParts; i >= 1; --i) {
        const double of_target =
            slopes.go_back(*--now, course.target(i), most[row], fastest[row], steps[k] / kParts);
        const double share = held ? 0.0 : Course::share(i);
        of_u[k] += (1.0 - share) * of_target;
        of_u[k + 1] += share * of_target;
      }
    }
    of_u[0] += slopes.place + slope[row * num_times];
    of_most[row] = slopes.most;
    of_fastest[row] = slopes.fastest;
  }
}

void follow(Follow how, std::int64_t num_rows, std::int64_t num_times, const double* targets,
            const double* room, std::int64_t room_stride, double* out) {
  const std::int64_t room_step = room_stride == 1 ? 0 : 1;
  const auto walk = how == Follow::play ? follow_row<Follow::play> : follow_row<Follow::slowed>;
  for (std::int64_t row = 0; row < num_rows; ++row)
    walk(num_times, targets + row * num_times, room + row * room_stride, room_step,
         out + row * num_times);
}

void find_intervals(std::int64_t num_times, const double* times, std::int64_t num_places,
                    const double* places, bool of_equal_after, std::int64_t* out) {
  const auto lies_after = [&](double place, double time) {
    return of_equal_after ? place >= time : place > time;
  };
  const double* const end = times + num_times;
  const std::int64_t last = num_times - 2;
  std::int64_t left = 0;
  for (std::int64_t i = 0; i < num_places; ++i) {
    const double place = places[i];
    const bool begins_before = left == 0 || lies_after(place, times[left]);
    // the interval of the place before, and the two after it
    std::int64_t near = left;
    while (near < last && near < left + 2 && lies_after(place, times[near + 1])) ++near;
    const bool ends_after = near == last || !lies_after(place, times[near + 1]);
    if (begins_before && ends_after) {
      left = near;
    } else {
      const double* const found = of_equal_after ? std::upper_bound(times, end, place)
                                                 : std::lower_bound(times, end, place);
      left = std::clamp<std::int64_t>(found - times - 1, 0, last);
    }
    out[i] = left;
  }
}

}  // namespace diffsim
