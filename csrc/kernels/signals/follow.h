// Maps of signals that go from one time to the next, and reading between times.
#pragma once

#include <cstdint>

namespace diffsim {

/// How a follower keeps to its target; `room` is what its rule says.
enum class Follow {
  play,    // rests until the target is farther away than half the gap, `room`
  slowed,  // goes to the target by at most `room`
  decays,  // keeps the share `room` of its state and adds the target
};

/// Followers of signals: `targets` and states are (num_rows, num_times), `room` is (num_rows,
/// num_times - 1), or, where `room_stride` is 1, (num_rows, 1) for all steps.
struct Followers {
  Follow how;
  std::int64_t num_rows, num_times;
  const double *targets, *room;
  std::int64_t room_stride;
};

/// State after each time; the first state is given in `states`.
///
/// A target or room that is not a number makes all that follow it so.
void follow(const Followers& f, double* states);

/// Gradients from those of the states; that of the first state is the start's. A limit that is just
/// reached has half of the slope of each side.
void follow_vjp(const Followers& f, const double* states, const double* grad_states,
                double* grad_targets, double* grad_room, double* grad_start);

/// Directions of the states; the first one is given in `d_states`.
void follow_tangent(const Followers& f, const double* states, const double* d_targets,
                    const double* d_room, double* d_states);

/// Parts of a step, in which what accelerates goes on.
constexpr int kParts = 16;

/// Points that go to targets with their acceleration limited, braking in time to stop there.
///
/// `targets` and places are (num_rows, num_times), `steps` (num_times - 1), `most` and `fastest`
/// (num_rows) the largest acceleration and speed. They begin at rest at the first target. Targets
/// are `held` until the next time, or straight between times. Each step is divided into `kParts`.
struct Approach {
  std::int64_t num_rows, num_times;
  const double *targets, *steps, *most, *fastest;
  bool held;
};

void approach(const Approach& a, double* places);

/// Gradients from those of the places.
void approach_vjp(const Approach& a, const double* grad_places, double* grad_targets,
                  double* grad_most, double* grad_fastest);

/// Directions of the places.
void approach_tangent(const Approach& a, const double* d_targets, const double* d_most,
                      const double* d_fastest, double* d_places);

/// Index of the interval of increasing `times` that holds each place, 0 to num_times - 2.
///
/// A place that is a time belongs to the interval after it, or to the one before it if not
/// `of_equal_after`. Places that go along with the times are found in one step each.
void find_intervals(std::int64_t num_times, const double* times, std::int64_t num_places,
                    const double* places, bool of_equal_after, std::int64_t* out);

/// Straight lines through `values` (num_rows, num_times) at increasing `times`, read at `places`
/// (num_rows, num_places); a stride of 0: one row for all.
///
/// The first and last line go on beyond the ends. A place that is a time has the slope of the line
/// before it, or, of `both_sides`, the mean of the two: then it is read on both.
struct Lines {
  std::int64_t num_rows, num_times, num_places;
  const double *values, *times, *places;
  std::int64_t value_stride, place_stride;
  bool both_sides;
};

void read_lines(const Lines& l, double* readings);

/// Adds the gradients from those of the readings.
void read_lines_vjp(const Lines& l, const double* grad_readings, double* grad_values,
                    double* grad_places);

/// Directions of the readings.
void read_lines_tangent(const Lines& l, const double* d_values, const double* d_places,
                        double* d_readings);

}  // namespace diffsim
