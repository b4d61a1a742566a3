#include "kernels/signals/follow.h"

#include <algorithm>

#include "kernels/signals/clipped.h"

namespace diffsim {

namespace {

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

}  // namespace

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
