#include "kernels/stokes/closest_curve.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace diffsim {
namespace {

constexpr int kParts = 8;         // of a curve
constexpr int kMaxDepth = 26;     // of bisection by sign changes: intervals of 1e-8 of a part
constexpr int kMaxSteps = 80;     // of Newton's method; 5 are usual
constexpr double kNoise = 4e-16;  // coefficients below, relative to the largest, count as zero
constexpr double kMoved = 1e-9;   // Newton's last step: the next one would be lost in rounding
constexpr double kTied = 1e-13;   // of the size: distances that are equal
constexpr double kAside = 1e-5;   // parameter distance of the tangents beside a corner

struct Vec2 {
  double x = 0.0, y = 0.0;
};

Vec2 operator+(Vec2 a, Vec2 b) { return {a.x + b.x, a.y + b.y}; }
Vec2 operator-(Vec2 a, Vec2 b) { return {a.x - b.x, a.y - b.y}; }
Vec2 operator*(double s, Vec2 a) { return {s * a.x, s * a.y}; }
double dot(Vec2 a, Vec2 b) { return a.x * b.x + a.y * b.y; }
double norm(Vec2 a) { return std::sqrt(dot(a, a)); }

using Polynomial = std::vector<double>;  // Bernstein coefficients on [0, 1]

/// C(n, 0), ..., C(n, n).
Polynomial binomials(int n) {
  Polynomial c(n + 1, 1.0);
  for (int k = 1; k < n; ++k) c[k] = c[k - 1] * (n - k + 1) / k;
  return c;
}

Polynomial product(const Polynomial& a, const Polynomial& b) {
  const int m = static_cast<int>(a.size()) - 1, n = static_cast<int>(b.size()) - 1;
  const Polynomial of_a = binomials(m), of_b = binomials(n), of_c = binomials(m + n);
  Polynomial c(m + n + 1, 0.0);
  for (int i = 0; i <= m; ++i)
    for (int j = 0; j <= n; ++j) c[i + j] += of_a[i] * a[i] * of_b[j] * b[j];
  for (int k = 0; k <= m + n; ++k) c[k] /= of_c[k];
  return c;
}

Polynomial derivative(const Polynomial& a) {
  const int n = static_cast<int>(a.size()) - 1;
  Polynomial d(n);
  for (int k = 0; k < n; ++k) d[k] = n * (a[k + 1] - a[k]);
  return d;
}

Polynomial difference(Polynomial a, const Polynomial& b) {
  for (std::size_t k = 0; k < a.size(); ++k) a[k] -= b[k];
  return a;
}

/// Coefficients on [start, end] of [0, 1] (blossoming).
Polynomial restricted(const Polynomial& a, double start, double end) {
  const int n = static_cast<int>(a.size()) - 1;
  Polynomial out(n + 1);
  for (int k = 0; k <= n; ++k) {
    Polynomial row = a;
    for (int level = 0; level < n; ++level) {
      const double t = level < k ? end : start;
      for (int i = 0; i < n - level; ++i) row[i] = (1.0 - t) * row[i] + t * row[i + 1];
    }
    out[k] = row[0];
  }
  return out;
}

class ClosestOnCurves {
 public:
  explicit ClosestOnCurves(const CurveChain& chain)
      : chain_(chain), end_(static_cast<double>(chain.num_curves)) {
    choose_curve_ = binomials(chain.degree - 1);
    const double* w = chain.homogeneous + 2;
    for (std::int64_t i = 0; i < chain.num_curves * (chain.degree + 1); ++i)
      rational_ |= w[3 * i] != w[0];
    for (std::int64_t c = 0; c < chain.num_curves; ++c)
      for (int k = 0; k < kParts; ++k) add_part(c, k);
    const std::int64_t count = chain.num_curves * kParts + (chain.closed ? 0 : 1);
    for (std::int64_t k = 0; k < count; ++k) ends_.push_back(at(static_cast<double>(k) / kParts));
    if (chain.rays != nullptr) {
      ends_.front().tangent = -chain.size * ray(0);
      ends_.back().tangent = chain.size * ray(1);
    }
    choose_g_ = binomials(order_ - 1);
    halves_.resize(2 * (order_ + 1) * (kMaxDepth + 1));
    g_.resize(order_ + 1);
  }

  /// Parameter of the point closest to p, and the normal there.
  double closest(Vec2 p, Vec2& normal) {
    p_ = p;
    near_.clear();
    least_ = std::numeric_limits<double>::infinity();
    offer_ends();
    if (chain_.rays != nullptr) offer_rays();
    for (std::size_t k = 0; k < radius_.size(); ++k) {
      const double reach = least_ + 1e-12 * chain_.size + radius_[k];
      const Vec2 away = p - center_[k];
      if (dot(away, away) <= reach * reach) offer_part(k);
    }
    const Candidate* first = &near_.back();  // whatever comes of NaN
    for (const Candidate& c : near_) {
      const bool beats =
          first->distance > least_ + kTied * chain_.size || c.place.tau < first->place.tau;
      if (c.distance <= least_ + kTied * chain_.size && beats) first = &c;
    }
    normal = normal_at(first->place, first->distance);
    return first->place.tau;
  }

 private:
  struct Place {
    double tau;
    Vec2 x, tangent;  // point of the chain, dx/dt
  };
  struct Candidate {
    Place place;
    double distance;
  };

  Vec2 ray(int end) const { return {chain_.rays[2 * end], chain_.rays[2 * end + 1]}; }

  /// Beyond the ends those of the ends, or wrapped.
  Place at(double tau) const {
    const double in = chain_.closed ? tau - std::floor(tau / end_) * end_ : tau;
    const double curve = in > 0.0 ? std::min(std::floor(in), end_ - 1.0) : 0.0;  // of NaN 0, too
    const double t = std::clamp(in - curve, 0.0, 1.0), s = 1.0 - t;
    const int n = chain_.degree;
    const double* from = chain_.homogeneous + static_cast<std::int64_t>(curve) * 3 * (n + 1);
    double h[6];  // the last step of de Casteljau: w x, w y, w on both sides
    std::copy(from, from + 6, h);
    double power = 1.0;
    for (int k = 1; k < n; ++k) {
      power *= t;
      const double weight = power * choose_curve_[k];
      for (int i = 0; i < 6; ++i) h[i] = s * h[i] + weight * from[3 * k + i];
    }
    const double per_w = 1.0 / (s * h[2] + t * h[5]);
    const Vec2 x = per_w * Vec2{s * h[0] + t * h[3], s * h[1] + t * h[4]};
    return {tau, x, n * per_w * (Vec2{h[3] - h[0], h[4] - h[1]} - (h[5] - h[2]) * x)};
  }

  Vec2 normal_at(const Place& place, double distance) {
    const Vec2 away = p_ - place.x;
    const double length = norm(place.tangent);
    const bool apart = distance > 1e-10 * chain_.size;
    const bool smooth = length > 1e-7 * chain_.size;
    Vec2 along = smooth ? (1.0 / length) * place.tangent : place.tangent;
    const bool corner = !smooth || (apart && std::abs(dot(away, along)) > 1e-6 * distance);
    if (corner) along = between(place.tau);
    const Vec2 left{-along.y, along.x};
    if (!corner || !apart) return left;
    return (dot(left, away) < 0.0 ? -1.0 : 1.0) / distance * away;
  }

  /// Mean direction of the curve before and after a corner, cusp or end.
  Vec2 between(double tau) {
    const double least = 1e-12 * chain_.size;  // slower is standing still: the other side decides
    Vec2 before = at(tau - kAside).tangent, after = at(tau + kAside).tangent;
    before = (1.0 / std::max(norm(before), least)) * before;
    after = (1.0 / std::max(norm(after), least)) * after;
    const Vec2 sum = before + after;
    const double length = norm(sum);
    // The curve that returns the way it came has no side: take the way on.
    return length < 1e-9 ? after : (1.0 / length) * sum;
  }

  void add_part(std::int64_t curve, int k) {
    const int n = chain_.degree;
    const double* from = chain_.homogeneous + curve * 3 * (n + 1);
    Polynomial of[3];
    for (int c = 0; c < 3; ++c) {
      Polynomial whole(n + 1);
      for (int i = 0; i <= n; ++i) whole[i] = from[3 * i + c];
      of[c] = restricted(whole, static_cast<double>(k) / kParts, (k + 1.0) / kParts);
    }
    Polynomial a, d[2];
    const Polynomial& w = of[2];
    for (int c = 0; c < 2; ++c) {
      // g over w where all weights are the same: of degree 2 n - 1 instead of 3 n - 1
      const Polynomial along =
          rational_ ? difference(product(derivative(of[c]), w), product(of[c], derivative(w)))
                    : derivative(of[c]);
      const Polynomial part = product(of[c], along);
      if (c == 0) a = Polynomial(part.size(), 0.0);
      for (std::size_t i = 0; i < a.size(); ++i) a[i] += part[i];
      d[c] = product(w, along);
    }
    order_ = static_cast<int>(a.size()) - 1;
    for (const Polynomial& each : {a, d[0], d[1]})
      coefficients_.insert(coefficients_.end(), each.begin(), each.end());
    add_disc(of);
  }

  /// A disc that holds the part, which lies in the hull of its control points.
  void add_disc(const Polynomial (&of)[3]) {
    const double inf = std::numeric_limits<double>::infinity();
    Vec2 low{inf, inf}, high{-inf, -inf};
    std::vector<Vec2> corners;
    for (std::size_t i = 0; i < of[0].size(); ++i) {
      const Vec2 x{of[0][i] / of[2][i], of[1][i] / of[2][i]};
      low = {std::min(low.x, x.x), std::min(low.y, x.y)};
      high = {std::max(high.x, x.x), std::max(high.y, x.y)};
      corners.push_back(x);
    }
    const Vec2 center = 0.5 * (low + high);
    double radius = 0.0;
    for (const Vec2& x : corners) radius = std::max(radius, norm(x - center));
    center_.push_back(center);
    radius_.push_back(radius);
  }

  void offer(const Place& place) {
    const double distance = norm(p_ - place.x);
    if (distance > least_ + kTied * chain_.size) return;
    least_ = std::min(least_, distance);
    near_.push_back({place, distance});
  }

  void offer_ends() {
    const auto square = [this](const Place& end) { return dot(p_ - end.x, p_ - end.x); };
    const Place* nearest = &ends_.front();
    double least = square(*nearest);
    for (const Place& end : ends_)
      if (const double d = square(end); d < least) least = d, nearest = &end;
    offer(*nearest);
  }

  void offer_rays() {
    for (int i = 0; i < 2; ++i) {
      const Place& end = i == 0 ? ends_.front() : ends_.back();
      const double s = dot(p_ - end.x, ray(i));
      if (s > 0.0) offer({i == 0 ? -s : end_ + s, end.x + s * ray(i), end.tangent});
    }
  }

  void offer_part(std::size_t part) {
    const int count = order_ + 1;
    const double* a = coefficients_.data() + part * 3 * count;
    double largest = 0.0;
    for (int k = 0; k < count; ++k) {
      g_[k] = a[k] - (p_.x * a[count + k] + p_.y * a[2 * count + k]);
      largest = std::max(largest, std::abs(g_[k]));
    }
    noise_ = kNoise * largest;
    part_ = static_cast<double>(part);
    offer_roots(g_.data(), 0.0, 1.0, 0);
  }

  void offer_root(double t) { offer(at((part_ + t) / kParts)); }

  /// Roots at which g goes from minus to plus, in an interval of the part.
  void offer_roots(const double* a, double start, double width, int depth) {
    int changes = 0, first = 0, last = 0;
    for (int k = 0; k <= order_; ++k) {
      if (std::abs(a[k]) <= noise_) continue;
      const int sign = a[k] > 0.0 ? 1 : -1;
      if (first == 0) first = sign;
      changes += last == -sign;
      last = sign;
    }
    if (changes == 1 && first < 0) return offer_root(start + width * single_root(a));
    const bool stuck = first == 0 || (changes > 1 && depth == kMaxDepth);
    if (stuck) return offer_root(start + 0.5 * width);
    if (changes < 2) return;
    double* low = halves_.data() + 2 * (order_ + 1) * depth;
    double* high = low + order_ + 1;
    std::copy(a, a + order_ + 1, high);
    for (int k = 0; k < order_; ++k) {
      low[k] = high[0];
      for (int i = 0; i < order_ - k; ++i) high[i] = 0.5 * (high[i] + high[i + 1]);
    }
    low[order_] = high[0];
    if (std::abs(high[0]) <= noise_)
      offer_root(start + 0.5 * width);  // at the cut: in neither half
    offer_roots(low, start, 0.5 * width, depth + 1);
    offer_roots(high, start + 0.5 * width, 0.5 * width, depth + 1);
  }

  /// The root of a polynomial that rises through zero once in [0, 1]: Newton within a bracket.
  double single_root(const double* a) {
    double t = a[0] / (a[0] - a[order_]), low = 0.0, high = 1.0;
    if (!(t > 0.0 && t < 1.0)) t = 0.5;
    for (int step = 0; step < kMaxSteps; ++step) {
      const double s = 1.0 - t;
      // What de Casteljau interpolates last, by Horner's scheme: half of its time.
      double low_half = a[0], high_half = a[1], power = 1.0;
      for (int k = 1; k < order_; ++k) {
        power *= t;
        const double weight = power * choose_g_[k];
        low_half = s * low_half + weight * a[k];
        high_half = s * high_half + weight * a[k + 1];
      }
      const double value = s * low_half + t * high_half, slope = order_ * (high_half - low_half);
      if (value <= 0.0) low = t;
      if (value >= 0.0) high = t;
      const double newton = t - value / slope;
      // Ends included: a step that moves no more has arrived, and must not be thrown back.
      const bool inside = slope > 0.0 && newton >= low && newton <= high;
      const double next = inside ? newton : 0.5 * (low + high);
      const bool arrived = std::abs(next - t) <= (inside ? kMoved : kNoise);
      t = next;
      if (arrived) break;
    }
    return t;
  }

  const CurveChain& chain_;
  double end_;  // parameter of the end
  bool rational_ = false;
  int order_ = 1;                     // degree of g
  std::vector<double> coefficients_;  // of g, (num_parts, 3, order + 1): a, d
  std::vector<Vec2> center_;
  std::vector<double> radius_;                   // of the discs
  std::vector<Place> ends_;                      // of the parts
  std::vector<double> choose_curve_, choose_g_;  // binomials of a degree less
  std::vector<double> halves_, g_;               // scratch
  std::vector<Candidate> near_;
  Vec2 p_;
  double least_ = 0.0, noise_ = 0.0, part_ = 0.0;
};

}  // namespace

void closest_on_curves(const CurveChain& chain, const double* p, std::int64_t num_points,
                       double* tau, double* normal) {
  ClosestOnCurves curves(chain);
  for (std::int64_t i = 0; i < num_points; ++i) {
    Vec2 n;
    const Vec2 at{p[2 * i], p[2 * i + 1]};
    tau[i] = curves.closest(at, n);
    normal[2 * i] = n.x;
    normal[2 * i + 1] = n.y;
  }
}

}  // namespace diffsim
