// Maps of signals that go from one time to the next, and reading between times.
#pragma once

#include <cstdint>

namespace diffsim {

/// How a follower keeps to its target.
enum class Follow {
  play,    // rests until the target is farther away than half the gap
  slowed,  // goes to the target by at most the given way
};

/// State of a follower after each time; the first state is given in `out`.
///
/// `targets` and `out` are (num_rows, num_times). `room` is (num_rows, num_times - 1) or, where
/// `room_stride` is 1, (num_rows, 1): half of the gap, or the longest way, of each step.
/// A target or room that is not a number makes all that follow it so.
void follow(Follow how, std::int64_t num_rows, std::int64_t num_times, const double* targets,
            const double* room, std::int64_t room_stride, double* out);

/// Index of the interval of increasing `times` that holds each place, 0 to num_times - 2.
///
/// A place that is a time belongs to the interval after it, or to the one before it if not
/// `of_equal_after`. Places that go along with the times are found in one step each.
void find_intervals(std::int64_t num_times, const double* times, std::int64_t num_places,
                    const double* places, bool of_equal_after, std::int64_t* out);

}  // namespace diffsim
