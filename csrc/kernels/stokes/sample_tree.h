// The nearest of many points in space: a tree of boxes, halved along their longest side.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

namespace diffsim {

class SampleTree {
 public:
  struct Near {
    double square = std::numeric_limits<double>::infinity();  ///< of the distance
    std::int64_t index = -1;
    bool operator<(const Near& other) const {  // equally near: the lower index, whatever the tree
      return square < other.square || (square == other.square && index < other.index);
    }
  };

  /// @param points (num_points, 3), finite, at least one
  SampleTree(const double* points, std::int64_t num_points) {
    std::vector<Sample> samples(num_points);
    for (std::int64_t i = 0; i < num_points; ++i)
      samples[i] = {{points[3 * i], points[3 * i + 1], points[3 * i + 2]}, i};
    samples_.swap(samples);
    build(0, num_points);
  }

  /// Fills near[0, num) in order; num at most the number of points.
  void nearest(const double* p, int num, Near* near) const {
    std::fill(near, near + num, Near{});
    visit(0, p, num, near);
  }

 private:
  static constexpr std::int64_t kLeaf = 8;  // points; 4 to 16 take the same time

  struct Sample {
    double x[3];
    std::int64_t index;
  };
  struct Box {
    double low[3], high[3];
    std::int64_t begin, end;  // its samples
    std::int64_t second = 0;  // half; the first one follows the box itself; 0: a leaf
  };

  static double square(const double* p, const double* x) {
    const double a = p[0] - x[0], b = p[1] - x[1], c = p[2] - x[2];
    return a * a + b * b + c * c;
  }

  /// From a box, 0 inside.
  static double square(const double* p, const Box& box) {
    double sum = 0.0;
    for (int a = 0; a < 3; ++a) {
      const double away = std::max({box.low[a] - p[a], p[a] - box.high[a], 0.0});
      sum += away * away;
    }
    return sum;
  }

  std::int64_t build(std::int64_t begin, std::int64_t end) {
    const std::int64_t place = static_cast<std::int64_t>(boxes_.size());
    boxes_.push_back(box_around(begin, end));
    if (end - begin <= kLeaf) return place;
    const Box& box = boxes_.back();
    int axis = 0;
    for (int a = 1; a < 3; ++a)
      if (box.high[a] - box.low[a] > box.high[axis] - box.low[axis]) axis = a;
    const std::int64_t middle = begin + (end - begin) / 2;
    const auto before = [axis](const Sample& s, const Sample& t) { return s.x[axis] < t.x[axis]; };
    std::nth_element(samples_.begin() + begin, samples_.begin() + middle, samples_.begin() + end,
                     before);
    build(begin, middle);
    const std::int64_t second = build(middle, end);
    boxes_[place].second = second;  // not `box`: building moved the boxes
    return place;
  }

  Box box_around(std::int64_t begin, std::int64_t end) const {
    Box box;
    box.begin = begin, box.end = end;
    for (int a = 0; a < 3; ++a) {
      box.low[a] = box.high[a] = samples_[begin].x[a];
      for (std::int64_t i = begin + 1; i < end; ++i) {
        box.low[a] = std::min(box.low[a], samples_[i].x[a]);
        box.high[a] = std::max(box.high[a], samples_[i].x[a]);
      }
    }
    return box;
  }

  void visit(std::int64_t place, const double* p, int num, Near* near) const {
    const Box& box = boxes_[place];
    if (box.second == 0) {
      for (std::int64_t i = box.begin; i < box.end; ++i)
        offer({square(p, samples_[i].x), samples_[i].index}, num, near);
      return;
    }
    std::int64_t halves[2] = {place + 1, box.second};
    double squares[2] = {square(p, boxes_[halves[0]]), square(p, boxes_[halves[1]])};
    const int first = squares[1] < squares[0];
    for (const int half : {first, 1 - first})
      if (squares[half] <= near[num - 1].square) visit(halves[half], p, num, near);
  }

  static void offer(const Near& sample, int num, Near* near) {
    if (!(sample < near[num - 1])) return;
    int k = num - 1;
    for (; k > 0 && sample < near[k - 1]; --k) near[k] = near[k - 1];
    near[k] = sample;
  }

  std::vector<Sample> samples_;
  std::vector<Box> boxes_;  // each before those within it
};

}  // namespace diffsim
