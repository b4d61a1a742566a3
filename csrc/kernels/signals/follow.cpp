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

namespace {

/// Finds the intervals of places that mostly go along with the times.
class Search {
 public:
  Search(std::int64_t num_times, const double* times)
      : times_(times), end_(times + num_times), last_(num_times - 2) {}

  /// @param lies_after  whether a place is beyond a time
  /// @param bound       std::lower_bound or std::upper_bound, as lies_after has it
  template <typename After, typename Bound>
  std::int64_t find(double place, const After& lies_after, const Bound& bound) {
    const bool begins_before = left_ == 0 || lies_after(place, times_[left_]);
    // the interval of the place before, and the two after it
    std::int64_t near = left_;
    while (near < last_ && near < left_ + 2 && lies_after(place, times_[near + 1])) ++near;
    const bool ends_after = near == last_ || !lies_after(place, times_[near + 1]);
    left_ = begins_before && ends_after
                ? near
                : std::clamp<std::int64_t>(bound(times_, end_, place) - times_ - 1, 0, last_);
    return left_;
  }

  std::int64_t before(double place) {
    return find(
        place, [](double at, double time) { return at > time; },
        [](auto... range) { return std::lower_bound(range...); });
  }
  std::int64_t after(double place) {
    return find(
        place, [](double at, double time) { return at >= time; },
        [](auto... range) { return std::upper_bound(range...); });
  }

 private:
  const double *times_, *end_;
  std::int64_t last_, left_ = 0;
};

/// Calls visit(row, place's index, interval, place, whether the next line is read, too).
template <typename Visit>
void each_line(const Lines& l, const Visit& visit) {
  for (std::int64_t row = 0; row < l.num_rows; ++row) {
    Search search(l.num_times, l.times);
    const double* const places = l.places + row * l.place_stride;
    for (std::int64_t i = 0; i < l.num_places; ++i) {
      const std::int64_t k = search.before(places[i]);
      const bool two = l.both_sides && k + 2 < l.num_times && places[i] == l.times[k + 1];
      visit(row, i, k, places[i], two);
    }
  }
}

}  // namespace

void find_intervals(std::int64_t num_times, const double* times, std::int64_t num_places,
                    const double* places, bool of_equal_after, std::int64_t* out) {
  Search search(num_times, times);
  for (std::int64_t i = 0; i < num_places; ++i)
    out[i] = of_equal_after ? search.after(places[i]) : search.before(places[i]);
}

void read_lines(const Lines& l, double* readings) {
  each_line(l, [&](std::int64_t row, std::int64_t i, std::int64_t k, double place, bool two) {
    const double *y = l.values + row * l.value_stride + k, *t = l.times + k;
    double& out = readings[row * l.num_places + i];
    out = y[0] + (place - t[0]) / (t[1] - t[0]) * (y[1] - y[0]);
    // at its end a line is rounded as in between; the next one begins with the value itself
    if (two) out = 0.5 * (out + y[1]);
  });
}

void read_lines_vjp(const Lines& l, const double* grad_readings, double* grad_values,
                    double* grad_places) {
  each_line(l, [&](std::int64_t row, std::int64_t i, std::int64_t k, double place, bool two) {
    const double *y = l.values + row * l.value_stride + k, *t = l.times + k;
    double *gy = grad_values + row * l.value_stride + k, *gp = grad_places + row * l.place_stride;
    const double g = grad_readings[row * l.num_places + i];
    const double of_line = two ? 0.5 * g : g, width = t[1] - t[0], share = (place - t[0]) / width;
    gy[0] += of_line * (1.0 - share);
    gy[1] += of_line * share;
    gp[i] += of_line * ((y[1] - y[0]) / width);
    if (!two) return;
    gy[1] += of_line;
    gp[i] += of_line * ((y[2] - y[1]) / (t[2] - t[1]));
  });
}

void read_lines_tangent(const Lines& l, const double* d_values, const double* d_places,
                        double* d_readings) {
  each_line(l, [&](std::int64_t row, std::int64_t i, std::int64_t k, double place, bool two) {
    const double *y = l.values + row * l.value_stride + k, *t = l.times + k;
    const double* dy = d_values + row * l.value_stride + k;
    const double dp = d_places[row * l.place_stride + i];
    const double width = t[1] - t[0], share = (place - t[0]) / width;
    double& out = d_readings[row * l.num_places + i];
    out = dy[0] + share * (dy[1] - dy[0]) + dp * ((y[1] - y[0]) / width);
    if (two) out = 0.5 * (out + dy[1] + dp * ((y[2] - y[1]) / (t[2] - t[1])));
  });
}

}  // namespace diffsim
