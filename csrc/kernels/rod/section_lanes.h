// All sections of a rod, an element in each lane: they differ in numbers alone.
#pragma once

#include <algorithm>
#include <vector>

#include "kernels/rod/section.h"

namespace diffsim::rod {

class SectionLanes {
 public:
  explicit SectionLanes(std::int64_t num_tendons)
      : tension_(num_tendons), offset_(3 * num_tendons), slope_(3 * num_tendons) {}

  /// Section::solve of all elements of a rod.
  /// @param[in]  first   section of the first element, whose arrays hold those of the others, too
  /// @param[in]  radius  (num_elements)
  /// @param[out] rounds  (num_elements, kRounds + 1, 3)
  /// @param[out] moment  (num_elements, 3)
  void solve(const Section<double>& first, const double* radius, std::int64_t num_elements,
             double* rounds, double* moment) {
    for (std::int64_t begin = 0; begin < num_elements; begin += kNativeLanes) {
      for (int lane = 0; lane < kNativeLanes; ++lane)  // spare ones repeat the last element
        element_[lane] = std::min(begin + lane, num_elements - 1);
      Native v[3 * (kRounds + 1)], m[3];
      solve_register(first, radius, v, m);
      const auto used =
          static_cast<int>(std::min<std::int64_t>(kNativeLanes, num_elements - begin));
      give(v, 3 * (kRounds + 1), used, rounds);
      give(m, 3, used, moment);
    }
  }

 private:
  void solve_register(const Section<double>& first, const double* radius, Native* rounds,
                      Native* moment) {
    const std::int64_t num = first.num_tendons;
    const auto& of = first.of;
    Native u[3], force[3], bending[3], stretch[3], rest[3];
    take(first.u, u), take(first.force, force);
    take(of.bending, bending), take(of.stretch, stretch), take(of.rest, rest);
    for (std::int64_t t = 0; t < num; ++t) {
      tension_[t] = every(first.tension + t, num);
      take(of.offset + t * first.stride, &offset_[3 * t]);
      take(of.slope + t * first.stride, &slope_[3 * t]);
    }
    const Native stiffening = broadcast<Native>(*of.stiffening);
    const Native rubber = broadcast<Native>(*of.rubber);
    const Section<Native> section{
        num,
        3,
        every(radius, 1),
        u,
        force,
        tension_.data(),
        {bending, stretch, rest, &stiffening, offset_.data(), slope_.data(), &rubber}};
    section.solve(rounds, moment);
  }

  /// Of every element one number, `stride` from that of the next.
  Native every(const double* from, std::int64_t stride) const {
    Native out;
#pragma GCC unroll 8
    for (int lane = 0; lane < kNativeLanes; ++lane) out[lane] = from[stride * element_[lane]];
    return out;
  }
  /// Of every element three numbers.
  void take(const double* from, Native* out) const {
    for (int k = 0; k < 3; ++k) out[k] = every(from + k, 3);
  }
  /// Writes `size` numbers of each of the first elements.
  void give(const Native* from, int size, int count, double* to) const {
    for (int lane = 0; lane < count; ++lane)
      for (int k = 0; k < size; ++k) to[size * element_[lane] + k] = from[k][lane];
  }

  std::int64_t element_[kNativeLanes] = {};
  std::vector<Native> tension_, offset_, slope_;
};

}  // namespace diffsim::rod
