#include "kernels/stokes/closest_surface.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels/stokes/sample_tree.h"

namespace diffsim {
namespace {

constexpr int kMaxIters = 60;      // of Newton's method; 3 to 6 are usual
constexpr int kMaxShortened = 12;  // steps, to a quarter each
// Samples looked at for other sheets that are as near: close by, and farther away, where the
// nearest ones are more.
constexpr int kCloseNeighbors = 8, kFarNeighbors = 24;
constexpr double kCloseBy = 4.0;  // sample spacings
// Without kinks three searches find what more would; four pieces may meet at a corner.
constexpr int kMaxSmoothSheets = 3, kMaxSheets = 6;
constexpr std::int64_t kBeside = 3;  // samples along each parameter that are on one sheet
constexpr double kLeastBend = 1e-5;  // eigenvalue taken where H is singular: curvature's center
constexpr double kAside = 1e-12;  // parameter distance at which feet on a kink are held beside it
constexpr double kOver = 2.5 * kAside;  // steps over a kink, from one of its sides to the other
constexpr double kBetter = 1e-11;  // f beyond a kink must fall by this part, or rounding decides
constexpr int kMaxPieces = 6;      // entered one after the other, over their kinks
constexpr double kLongest = 4.0;   // step, in sample spacings
constexpr double kMoved = 1e-13;   // parameter step that ends the search
constexpr double kFalls = 1e-22;   // of f, to first order: the next step is lost in rounding
constexpr double kNoise = 1e-12;   // of f: a step that should gain less may climb by rounding
constexpr double kTiny = 1e-300;   // instead of dividing by zero
constexpr std::int64_t kPointsAtOnce = 512;  // of a task

struct Pair {
  double u[2];
  double& operator[](int k) { return u[k]; }
  double operator[](int k) const { return u[k]; }
};

struct Foot {
  Pair uv;
  double f, slope;
};

struct Range {
  Pair low, high;
};

Pair held_in(const Range& range, const Pair& x) {
  Pair out;
  for (int k = 0; k < 2; ++k) out[k] = std::max(std::min(x[k], range.high[k]), range.low[k]);
  return out;
}

/// f = |S - p|^2 / 2 and its derivatives; matrices are uu, uv, vv.
struct Objective {
  double f;
  Pair gradient;
  double gauss[3];  // first fundamental form
  double bend[3];   // what the curvature adds to the Hessian
};

Objective objective(const SurfaceJet& jet, Four p) {
  const Four e = jet.s - p;
  return {0.5 * dot(e, e),
          {dot(e, jet.su), dot(e, jet.sv)},
          {dot(jet.su, jet.su), dot(jet.su, jet.sv), dot(jet.sv, jet.sv)},
          {dot(e, jet.suu), dot(e, jet.suv), dot(e, jet.svv)}};
}

double half_square(const SurfaceJet& jet, Four p) {
  const Four e = jet.s - p;
  return 0.5 * dot(e, e);
}

/// -|H|^-1 g, the eigenvalues of H taken positive in the metric of the surface; held ones 0.
///
/// In coordinates in which the first fundamental form is the identity, H = gauss + bend becomes
/// a, b, c; its eigenvalues are m +- r.
Pair newton_step(const Objective& at, const bool (&held)[2]) {
  const double free[2] = {held[0] ? 0.0 : 1.0, held[1] ? 0.0 : 1.0};
  const double both = free[0] * free[1];
  const double guu = at.gauss[0], guv = at.gauss[1], gvv = at.gauss[2];
  const double huu = guu + at.bend[0], huv = guv + at.bend[1], hvv = gvv + at.bend[2];
  const double l11 = std::sqrt(guu + kTiny), l21 = both * guv / l11;
  // Where S_u and S_v are parallel rounding decides what is left: no less than 1e-14 of it.
  const double l22 = std::sqrt(std::max(gvv - l21 * l21, 1e-14 * gvv + kTiny));
  const double shear = l21 / l11;
  const double a = huu / (l11 * l11);
  const double b = both * (huv - shear * huu) / (l11 * l22);
  const double c = (hvv - 2.0 * both * shear * huv + shear * shear * huu) / (l22 * l22);
  const double ga = free[0] * at.gradient[0] / l11;
  const double gb = (free[1] * at.gradient[1] - l21 * ga) / l22;
  const double m = 0.5 * (a + c), d = 0.5 * (a - c), r = std::hypot(d, b);
  const double per_high = 1.0 / std::max(std::abs(m + r), kLeastBend);
  const double per_low = 1.0 / std::max(std::abs(m - r), kLeastBend);
  // |H|^-1 = (p + q (H - m) / r), p and q from the inverses of the two eigenvalues
  const double p = 0.5 * (per_high + per_low), q = 0.5 * (per_high - per_low) / std::max(r, kTiny);
  const double ya = -(p * ga + q * (d * ga + b * gb));
  const double yb = -(p * gb + q * (b * ga - d * gb));
  const double v = yb / l22;
  return {{free[0] * (ya - l21 * v) / l11, free[1] * v}};
}

class SurfaceSearch {
 public:
  SurfaceSearch(const SplineSurface& surface, const SurfaceSamples& samples)
      : evaluator_(surface),
        samples_(samples),
        tree_(samples.points, samples.num[0] * samples.num[1]) {
    for (int k = 0; k < 2; ++k) {
      collect_kinks(surface.axes[k], kinks_[k]);
      number_pieces(k);
    }
    max_sheets_ = kinks_[0].empty() && kinks_[1].empty() ? kMaxSmoothSheets : kMaxSheets;
  }

  Foot closest(const double* p, double band) const {
    SampleTree::Near near[kFarNeighbors];
    tree_.nearest(p, 1, near);
    const double distance = std::sqrt(near[0].square);
    if (!(distance <= band + samples_.gap)) return {sample(near[0].index), 0.0, 0.0};
    const int wanted = distance <= kCloseBy * samples_.gap ? kCloseNeighbors : kFarNeighbors;
    const std::int64_t num = std::min<std::int64_t>(wanted, samples_.num[0] * samples_.num[1]);
    tree_.nearest(p, static_cast<int>(num), near);
    return best_of_sheets(near, static_cast<int>(num), Four{p[0], p[1], p[2], 1.0});
  }

 private:
  Pair sample(std::int64_t index) const {
    return {{samples_.uv[2 * index], samples_.uv[2 * index + 1]}};
  }

  bool periodic(int k) const { return std::isinf(evaluator_.axis(k).low); }

  /// Kinks, on a turn also the last one before it and the first one after it.
  static void collect_kinks(const SplineAxis& axis, std::vector<double>& kinks) {
    kinks.assign(axis.kinks, axis.kinks + axis.num_kinks);
    if (kinks.empty() || !std::isinf(axis.low)) return;
    const double first = kinks.front(), last = kinks.back();
    kinks.insert(kinks.begin(), last - 1.0);
    kinks.push_back(first + 1.0);
  }

  /// Piece without kinks of every row of samples; the last one before a turn is the first one.
  void number_pieces(int k) {
    const std::int64_t num = samples_.num[k], stride = k == 0 ? samples_.num[1] : 1;
    const std::vector<double>& kinks = kinks_[k];
    piece_of_[k].assign(num, 0);
    for (std::int64_t i = 0; i < num && !kinks.empty(); ++i) {
      const auto after = std::upper_bound(kinks.begin(), kinks.end(), sample(i * stride)[k]);
      piece_of_[k][i] = after - kinks.begin();
      if (periodic(k)) piece_of_[k][i] %= evaluator_.axis(k).num_kinks;
    }
  }

  /// Range of the piece without kinks in which uv lies.
  Range piece(const Pair& uv) const {
    Range range;
    for (int k = 0; k < 2; ++k) {
      const SplineAxis& axis = evaluator_.axis(k);
      const std::vector<double>& kinks = kinks_[k];
      range.low[k] = axis.low, range.high[k] = axis.high;
      if (kinks.empty()) continue;
      const double turns = periodic(k) ? std::floor(uv[k]) : 0.0;
      const auto after = std::upper_bound(kinks.begin(), kinks.end(), uv[k] - turns);
      if (after != kinks.begin()) range.low[k] = *(after - 1) + kAside + turns;
      if (after != kinks.end()) range.high[k] = *after - kAside + turns;
    }
    return range;
  }

  Foot best_of_sheets(const SampleTree::Near* near, int num, Four p) const {
    std::int64_t seen[kMaxSheets] = {near[0].index};
    Foot best = descend_over(sample(seen[0]), p);
    for (int sheet = 1; sheet < max_sheets_; ++sheet) {
      seen[sheet] = other_sheet(near, num, seen, sheet);
      if (seen[sheet] < 0) break;
      const Foot foot = descend_over(sample(seen[sheet]), p);
      if (foot.f < best.f) best = foot;
    }
    return best;
  }

  /// First of the samples that is not beside those seen; -1: none.
  std::int64_t other_sheet(const SampleTree::Near* near, int num, const std::int64_t* seen,
                           int num_seen) const {
    for (int i = 0; i < num; ++i) {
      bool apart = true;
      for (int k = 0; k < num_seen; ++k) apart = apart && !beside(near[i].index, seen[k]);
      if (apart) return near[i].index;
    }
    return -1;
  }

  bool beside(std::int64_t i, std::int64_t j) const {
    const std::int64_t n = samples_.num[1];
    return beside(0, i / n, j / n) && beside(1, i % n, j % n);
  }

  /// Feet on both sides of a valley may be closer than samples: other pieces are other sheets.
  bool beside(int k, std::int64_t i, std::int64_t j) const {
    std::int64_t away = std::abs(i - j);
    if (periodic(k)) away = std::min(away, samples_.num[k] - away);
    return away <= kBeside && piece_of_[k][i] == piece_of_[k][j];
  }

  /// `descend` that goes on beyond a kink at which it was held.
  Foot descend_over(const Pair& start, Four p) const {
    const Range first = piece(start);
    Foot best = descend(held_in(first, start), first, p);
    bool moved = true;
    for (int entered = 0; moved && entered < kMaxPieces; ++entered) {
      moved = false;
      for (int k = 0; k < 2; ++k) moved |= !kinks_[k].empty() && enter_next(k, best, p);
    }
    return best;
  }

  /// Whether the piece beyond the kink at which a foot is held has a better one, which replaces it.
  bool enter_next(int k, Foot& foot, Four p) const {
    const Range here = piece(foot.uv);
    const int side = (foot.uv[k] >= here.high[k]) - (foot.uv[k] <= here.low[k]);
    Pair over = foot.uv;
    over[k] += kOver * side;
    const SplineAxis& axis = evaluator_.axis(k);
    if (side == 0 || !(over[k] > axis.low && over[k] < axis.high)) return false;
    const Foot beyond = descend(over, piece(over), p);
    if (!(beyond.f < foot.f * (1.0 - kBetter))) return false;
    foot = beyond;
    return true;
  }

  /// Local minimum of f in a range, from a start in it.
  Foot descend(const Pair& start, const Range& range, Four p) const {
    Foot foot{start, 0.0, 0.0};
    SurfaceJet jet = evaluator_.at(start.u);
    for (int iteration = 0; iteration < kMaxIters; ++iteration) {
      const Objective here = objective(jet, p);
      bool held[2];
      const Pair step = bounded_step(here, foot.uv, range, held);
      foot.slope = slope(here, held);
      const double falls = -(here.gradient[0] * step[0] + here.gradient[1] * step[1]);
      Pair trial = held_in(range, {{foot.uv[0] + step[0], foot.uv[1] + step[1]}});
      jet = evaluator_.at(trial.u);
      double f = half_square(jet, p), shrink = 1.0;
      for (int i = 0; i < kMaxShortened && f > here.f && falls > kNoise * here.f; ++i) {
        shrink *= 0.25;
        trial = held_in(range, {{foot.uv[0] + shrink * step[0], foot.uv[1] + shrink * step[1]}});
        jet = evaluator_.at(trial.u);
        f = half_square(jet, p);
      }
      foot.f = std::min(here.f, f);
      if (f > here.f) break;  // nowhere lower
      const double moved =
          std::max(std::abs(trial[0] - foot.uv[0]), std::abs(trial[1] - foot.uv[1]));
      foot.uv = trial;
      if (moved <= kMoved || falls <= kFalls * here.f) break;
    }
    return foot;
  }

  /// Newton's step, at most a few samples long; held are parameters that push against their range.
  Pair bounded_step(const Objective& here, const Pair& x, const Range& range,
                    bool (&held)[2]) const {
    for (int k = 0; k < 2; ++k)
      held[k] = (x[k] <= range.low[k] && here.gradient[k] > 0.0) ||
                (x[k] >= range.high[k] && here.gradient[k] < 0.0);
    Pair step = newton_step(here, held);
    double longer = 1.0;
    for (int k = 0; k < 2; ++k)
      longer = std::max(longer, std::abs(step[k]) * samples_.num[k] / kLongest);
    return {{step[0] / longer, step[1] / longer}};
  }

  static double slope(const Objective& here, const bool (&held)[2]) {
    double steepest = 0.0;
    for (int k = 0; k < 2; ++k)
      if (!held[k]) {
        const double length = std::max(std::sqrt(here.gauss[2 * k]), kTiny);
        steepest = std::max(steepest, std::abs(here.gradient[k]) / length);
      }
    return steepest / std::max(std::sqrt(2.0 * here.f), kTiny);
  }

  SurfaceEvaluator evaluator_;
  SurfaceSamples samples_;
  SampleTree tree_;
  std::vector<double> kinks_[2];
  std::vector<std::int64_t> piece_of_[2];  // rows of samples
  int max_sheets_;
};

}  // namespace

void closest_on_surface(const SplineSurface& surface, const SurfaceSamples& samples,
                        const double* p, std::int64_t num_points, double band, double* uv,
                        double* slope, ThreadPool& pool) {
  const SurfaceSearch search(surface, samples);
  pool.run_ranges(num_points, kPointsAtOnce, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const Foot foot = search.closest(p + 3 * i, band);
      uv[2 * i] = foot.uv[0];
      uv[2 * i + 1] = foot.uv[1];
      slope[i] = foot.slope;
    }
  });
}

}  // namespace diffsim
