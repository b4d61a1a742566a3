// One rod of given strains from its base to its tip: frames, forces, sections, places, residual.
//
// With R_i the frame in the middle of element i, n_i the force beyond it, d_i = R_i v_i:
//   x_{i+1} = x_i + h d_i,  c_i = x_i + h d_i / 2,
//   residual_i = m_i - R_i' (M_i - c_i x n_i),
//   M_i = sum_{j>i} c_j x w_j + (c_i + h d_i / 4) x w_i / 2 + sum of loads beyond: p x load.
#pragma once

#include <algorithm>
#include <type_traits>
#include <vector>

#include "kernels/rod/rod.h"
#include "kernels/rod/section_lanes.h"

namespace diffsim::rod {

inline double exp_of(double x) { return std::exp(x); }
inline Native exp_of(const Native& x) {
  Native out;
  for (int lane = 0; lane < kNativeLanes; ++lane) out[lane] = std::exp(x[lane]);
  return out;
}

constexpr double kSmoothing = 1e-3;  // bends below this do not count as a kink of a tendon [1/m]

template <class T>
struct Sweep {
  explicit Sweep(const Body& of)
      : body(of),
        begin(field_places(of)),
        n(of.num_elements),
        numbers(begin[kNumFields]),
        u(3 * n),
        edges(9 * (n + 1)),
        middles(9 * n),
        halves(9 * n),
        force(3 * n),
        local(3 * n),
        turns(n),
        wrapped(n),
        tension(n * of.num_tendons),
        rounds(3 * (kRounds + 1) * n),
        moment(3 * n),
        along(3 * n),
        nodes(3 * (n + 1)),
        centers(3 * n),
        places(3 * of.num_points),
        outer(3 * n),
        residual(3 * n),
        lanes_(of.num_tendons) {}

  /// The numbers and strains of another one, which do not move.
  void copy(const Sweep<double>& from) {
    std::copy(from.numbers.begin(), from.numbers.end(), numbers.begin());
    std::copy(from.u.begin(), from.u.end(), u.begin());
  }

  const T* field(Field f) const { return &numbers[begin[f]]; }
  double length(std::int64_t i) const { return body.edges[i + 1] - body.edges[i]; }
  double middle(std::int64_t i) const { return 0.5 * (body.edges[i + 1] + body.edges[i]); }
  const T* stretch(std::int64_t i) const { return &rounds[3 * ((kRounds + 1) * i + kRounds)]; }
  bool is_beyond(std::int64_t point, std::int64_t i) const {
    return body.point_at[point] > middle(i);
  }

  Section<T> section(std::int64_t i) const {
    return {body.num_tendons,
            3 * n,
            T{} + body.radius[i],
            &u[3 * i],
            &local[3 * i],
            &tension[i * body.num_tendons],
            section_numbers(numbers.data(), i)};
  }
  template <class Number>
  SectionNumbers<Number*> section_numbers(Number* of, std::int64_t i) const {
    const auto at = [&](Field f, std::int64_t k) { return of + begin[f] + k; };
    return {at(kBending, 3 * i), at(kStretch, 3 * i), at(kRest, 3 * i), at(kStiffening, 0),
            at(kOffset, 3 * i),  at(kSlope, 3 * i),   at(kRubber, 0)};
  }

  /// All from `numbers` and `u`.
  void run() {
    sum_forces();
    std::copy_n(field(kBase), 9, edges.begin());
    std::copy_n(field(kPlace), 3, nodes.begin());
    T turned = T{};
    for (std::int64_t i = 0; i < n; ++i) {
      turn_frame(i);
      turned = pull(i, turned);
      for (int k = 0; k < 3; ++k) local[3 * i + k] = T{}, along[3 * i + k] = T{};
      add_transposed(&middles[9 * i], &force[3 * i], &local[3 * i]);
    }
    solve_sections();
    for (std::int64_t i = 0; i < n; ++i) {
      add_product(&middles[9 * i], stretch(i), &along[3 * i]);
      for (int k = 0; k < 3; ++k) {
        const T step = length(i) * along[3 * i + k];
        centers[3 * i + k] = nodes[3 * i + k] + 0.5 * step;
        nodes[3 * (i + 1) + k] = nodes[3 * i + k] + step;
      }
    }
    for (std::int64_t p = 0; p < body.num_points; ++p) place(p);
    balance();
  }

  /// The frame in which a point turns: those of its element's first edge, halfway, and there.
  struct PointFrames {
    double past;
    T halfway[9], turned[9], there[9];
  };
  PointFrames point_frames(std::int64_t p) const {
    const std::int64_t i = body.around[p];
    PointFrames f;
    f.past = body.point_at[p] - body.edges[i];
    T w[3];
    for (int k = 0; k < 3; ++k) w[k] = (0.5 * f.past) * u[3 * i + k];
    turn(w, f.halfway);
    multiply(&edges[9 * i], f.halfway, f.turned);
    multiply(f.turned, f.halfway, f.there);
    return f;
  }

  Body body;
  std::array<std::int64_t, kNumFields + 1> begin;
  std::int64_t n;
  std::vector<T> numbers, u;
  std::vector<T> edges, middles, halves;  ///< rotations; by half an element
  std::vector<T> force, local;            ///< beyond, in the world and in the section
  std::vector<T> turns, wrapped, tension;
  std::vector<T> rounds, moment, along, nodes, centers, places, outer, residual;

 private:
  void solve_sections() {
    if constexpr (std::is_same_v<T, double>) {
      lanes_.solve(section(0), body.radius, n, rounds.data(), moment.data());
    } else {
      for (std::int64_t i = 0; i < n; ++i)
        section(i).solve(&rounds[3 * (kRounds + 1) * i], &moment[3 * i]);
    }
  }

  void sum_forces() {
    const T* weight = field(kWeight);
    T beyond[3] = {T{}, T{}, T{}};
    for (std::int64_t i = n - 1; i >= 0; --i)
      for (int k = 0; k < 3; ++k) {
        const T& own = weight[3 * i + k];
        force[3 * i + k] = beyond[k] + 0.5 * own;
        beyond[k] += own;
      }
    for (std::int64_t p = 0; p < body.num_loads; ++p)
      for (std::int64_t i = 0; i < n && is_beyond(p, i); ++i)
        add(1.0, field(kLoads) + 3 * p, &force[3 * i]);
  }

  void turn_frame(std::int64_t i) {
    T w[3];
    for (int k = 0; k < 3; ++k) w[k] = (0.5 * length(i)) * u[3 * i + k];
    turn(w, &halves[9 * i]);
    multiply(&edges[9 * i], &halves[9 * i], &middles[9 * i]);
    multiply(&middles[9 * i], &halves[9 * i], &edges[9 * (i + 1)]);
  }

  /// Tensions in element i, from the turn before it; returns the turn behind it.
  T pull(std::int64_t i, const T& before) {
    const T* own = &u[3 * i];
    turns[i] = length(i) * sqrt(own[1] * own[1] + own[2] * own[2] + kSmoothing * kSmoothing);
    const T behind = before + turns[i];
    wrapped[i] = behind - 0.5 * turns[i];
    const T loss = *field(kFriction) * wrapped[i] + middle(i) * *field(kWobble);
    const auto left = exp_of(-value_of(loss));
    const T share = chain(loss, left, -left);
    for (std::int64_t t = 0; t < body.num_tendons; ++t)
      tension[i * body.num_tendons + t] = field(kPull)[t] * field(kShare)[t * n + i] * share;
    return behind;
  }

  void place(std::int64_t p) {
    const std::int64_t i = body.around[p];
    const PointFrames f = point_frames(p);
    T axis[3] = {T{}, T{}, T{}};
    add_product(f.turned, stretch(i), axis);
    for (int k = 0; k < 3; ++k) places[3 * p + k] = nodes[3 * i + k] + f.past * axis[k];
    add_product(f.there, field(kPoints) + 3 * p, &places[3 * p]);
  }

  void balance() {
    const T* weight = field(kWeight);
    T beyond[3] = {T{}, T{}, T{}};  // moment of the elements beyond
    for (std::int64_t i = n - 1; i >= 0; --i) {
      T own[3], at[3];
      for (int k = 0; k < 3; ++k) {
        at[k] = centers[3 * i + k] + (0.25 * length(i)) * along[3 * i + k];
        own[k] = 0.5 * weight[3 * i + k];
        outer[3 * i + k] = beyond[k];
      }
      add_cross(at, own, &outer[3 * i]);
      add_cross(&force[3 * i], &centers[3 * i], &outer[3 * i]);
      add_cross(&centers[3 * i], weight + 3 * i, beyond);
    }
    for (std::int64_t p = 0; p < body.num_loads; ++p) {
      T torque[3] = {T{}, T{}, T{}};
      add_cross(&places[3 * p], field(kLoads) + 3 * p, torque);
      for (std::int64_t i = 0; i < n && is_beyond(p, i); ++i) add(1.0, torque, &outer[3 * i]);
    }
    for (std::int64_t i = 0; i < n; ++i) {
      T turned[3] = {T{}, T{}, T{}};
      add_transposed(&middles[9 * i], &outer[3 * i], turned);
      for (int k = 0; k < 3; ++k) residual[3 * i + k] = moment[3 * i + k] - turned[k];
    }
  }

  SectionLanes lanes_;
};

/// Adds dL/d(numbers, u) of a sweep that was run, from dL/d(residual, places).
template <class T>
void reverse(const Sweep<T>& s, const T* grad_residual, const T* grad_places, T* grad_numbers,
             T* grad_u);

}  // namespace diffsim::rod
