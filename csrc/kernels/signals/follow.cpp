#include "kernels/signals/follow.h"

#include <algorithm>

#include "kernels/signals/clipped.h"

namespace diffsim {

namespace {

/// The state that comes after `now`.
template <Follow how>
double next(double now, double target, double room) {
  switch (how) {
    case Follow::play:
      return clipped(now, target - room, target + room);
    case Follow::slowed:
      return clipped(target, now - room, now + room);
    case Follow::decays:
      return now * room + target;
  }
}

/// Slopes of `next`.
struct Slopes {
  double now, target, room;
};

template <Follow how>
Slopes slopes_at(double now, double target, double room) {
  if (how == Follow::decays) return {room, 1.0, now};
  const bool is_play = how == Follow::play;
  const double value = is_play ? now : target, middle = is_play ? target : now;
  const Shares part = shares(value, middle - room, middle + room);
  const double of_middle = part.low + part.high, of_room = part.high - part.low;
  return is_play ? Slopes{part.value, of_middle, of_room} : Slopes{of_middle, part.value, of_room};
}

/// Rows of one rule.
template <Follow how>
class Rows {
 public:
  explicit Rows(const Followers& followers)
      : f_(followers), room_step_(followers.room_stride == 1 ? 0 : 1) {}

  void run(std::int64_t row, double* states) const {
    for (std::int64_t k = 1; k < f_.num_times; ++k)
      states[k] = next<how>(states[k - 1], target(row)[k], room(row, k));
  }

  void pull(std::int64_t row, const double* states, const double* grad_states, double* grad_targets,
            double* grad_room, double* grad_start) const {
    double grad = 0.0;
    for (std::int64_t k = f_.num_times - 1; k > 0; --k) {
      grad += grad_states[k];
      const Slopes slopes = slopes_at<how>(states[k - 1], target(row)[k], room(row, k));
      grad_targets[k] = slopes.target * grad;
      grad_room[(k - 1) * room_step_] += slopes.room * grad;
      grad *= slopes.now;
    }
    *grad_start = grad + grad_states[0];
  }

  void push(std::int64_t row, const double* states, const double* d_targets, const double* d_room,
            double* d_states) const {
    for (std::int64_t k = 1; k < f_.num_times; ++k) {
      const Slopes slopes = slopes_at<how>(states[k - 1], target(row)[k], room(row, k));
      d_states[k] = slopes.now * d_states[k - 1] + slopes.target * d_targets[k] +
                    slopes.room * d_room[(k - 1) * room_step_];
    }
  }

 private:
  const double* target(std::int64_t row) const { return f_.targets + row * f_.num_times; }
  double room(std::int64_t row, std::int64_t k) const {
    return f_.room[row * f_.room_stride + (k - 1) * room_step_];
  }

  const Followers& f_;
  const std::int64_t room_step_;
};

/// `visit` of each row, by its rule.
template <typename Visit>
void each_row(const Followers& f, const Visit& visit) {
  const auto walk = [&](const auto& rows) {
    for (std::int64_t row = 0; row < f.num_rows; ++row)
      visit(rows, row, row * f.num_times, row * f.room_stride);
  };
  if (f.how == Follow::play) {
    walk(Rows<Follow::play>(f));
  } else if (f.how == Follow::slowed) {
    walk(Rows<Follow::slowed>(f));
  } else {
    walk(Rows<Follow::decays>(f));
  }
}

}  // namespace

void follow(const Followers& f, double* states) {
  each_row(f, [&](const auto& rows, std::int64_t row, std::int64_t at, std::int64_t) {
    rows.run(row, states + at);
  });
}

void follow_vjp(const Followers& f, const double* states, const double* grad_states,
                double* grad_targets, double* grad_room, double* grad_start) {
  each_row(f, [&](const auto& rows, std::int64_t row, std::int64_t at, std::int64_t room) {
    rows.pull(row, states + at, grad_states + at, grad_targets + at, grad_room + room,
              grad_start + row);
  });
}

void follow_tangent(const Followers& f, const double* states, const double* d_targets,
                    const double* d_room, double* d_states) {
  each_row(f, [&](const auto& rows, std::int64_t row, std::int64_t at, std::int64_t room) {
    rows.push(row, states + at, d_targets + at, d_room + room, d_states + at);
  });
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
