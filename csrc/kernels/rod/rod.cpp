#include "kernels/rod/rod.h"

#include <cmath>
#include <limits>

#include "kernels/linalg/dense.h"
#include "kernels/linalg/lane_lu.h"
#include "kernels/parallel.h"
#include "kernels/rod/slopes.h"

namespace diffsim::rod {

std::array<std::int64_t, kNumFields + 1> field_places(const Body& body) {
  const std::int64_t n = body.num_elements, t = body.num_tendons;
  std::array<std::int64_t, kNumFields> size;
  size.fill(1);  // friction and the like
  for (const Field f : {kBending, kStretch, kRest, kWeight}) size[f] = 3 * n;
  size[kLoads] = 3 * body.num_loads, size[kPoints] = 3 * body.num_points;
  size[kBase] = 9, size[kPlace] = 3;
  size[kOffset] = size[kSlope] = 3 * t * n, size[kShare] = t * n, size[kPull] = t;
  std::array<std::int64_t, kNumFields + 1> begin{};
  for (int f = 0; f < kNumFields; ++f) begin[f + 1] = begin[f] + size[f];
  return begin;
}

namespace {

constexpr double kMostTurn = 0.5;  // of all elements together in one step of Newton's method [rad]
constexpr double kGain = 0.1;      // steps that shrink less than by this need slopes of their place
constexpr double kLoose = 1e-3;    // tolerance on the way from no tension [rad]
constexpr std::int64_t kTask = 16;  // members: a thread's share, half a millisecond
constexpr double kFirstShare = 0.25, kLeastShare = 0.01;  // of the tension, in one step of that way

struct Member {
  std::int64_t row, column, index;
};

/// The numbers of one field of a member.
template <class Number>
Number* part(const Rows<Number>& rows, std::int64_t size, const Member& m) {
  return rows.data +
         ((rows.rows > 1 ? m.row : 0) * rows.columns + (rows.columns > 1 ? m.column : 0)) * size;
}

template <class F>
void each_field(const Body& body, F&& f) {
  const auto begin = field_places(body);
  for (int k = 0; k < kNumFields; ++k) f(k, begin[k], begin[k + 1] - begin[k]);
}

/// The turn of a step of the strains, of all elements together [rad].
template <class T>
T turn_of(const Sweep<T>& sweep, const T* step) {
  T sum{};
  for (std::int64_t i = 0; i < sweep.n; ++i)
    sum += sweep.length(i) * sqrt(dot(step + 3 * i, step + 3 * i));
  return sum;
}

/// A sweep of one member after another, and how its residual changes with the strains.
class Solver {
 public:
  explicit Solver(const Batch& batch)
      : plain(batch.body), batch_(batch), size_(3 * batch.body.num_elements), slopes_(batch.body) {}

  /// Takes the numbers of a member and its strains.
  void load(const Member& m, const double* strains) {
    each_field(batch_.body, [&](int f, std::int64_t begin, std::int64_t size) {
      std::copy_n(part(batch_.fields[f], size, m), size, &plain.numbers[begin]);
    });
    std::copy_n(strains, size_, plain.u.begin());
  }

  /// Slopes of the residual by the strains, or their transpose, where `plain` was run.
  dense::MatrixXd slopes(bool transposed) {
    dense::MatrixXd found(size_, size_);
    slopes_.find(plain, transposed ? size_ : 1, transposed ? 1 : size_, found.data());
    return found;
  }

  /// Newton's method from the strains of `plain`; slopes are kept while steps shrink fast.
  /// Returns the turn of the last step: above the tolerance or NaN if it does not settle.
  double settle(double tolerance) {
    plain.run();
    dense::Lu factor(slopes(false));
    double last = 0.0;
    for (int k = 0; k < kMostSteps; ++k) {
      dense::VectorXd step = factor.solve_one(plain.residual.data());
      double turn = turn_of(plain, step.data());
      if (k > 0 && !(turn < kGain * last)) {
        factor = dense::Lu(slopes(false));
        step = factor.solve_one(plain.residual.data());
        turn = turn_of(plain, step.data());
      }
      if (!std::isfinite(turn)) return turn;
      const double share = std::min(1.0, kMostTurn / turn);
      for (std::int64_t i = 0; i < size_; ++i) plain.u[i] -= share * step(i);
      plain.run();
      last = turn;
      if (turn < tolerance) return turn;
    }
    return last;
  }

  /// From no tension by growing shares of it.
  double settle_from_straight(double tolerance) {
    const std::int64_t begin = plain.begin[kPull], count = plain.begin[kPull + 1] - begin;
    const std::vector<double> pull(&plain.numbers[begin], &plain.numbers[begin] + count);
    const auto settle_at = [&](double share, double within) {
      for (std::int64_t t = 0; t < count; ++t) plain.numbers[begin + t] = share * pull[t];
      return settle(within);
    };
    std::fill(plain.u.begin(), plain.u.end(), 0.0);
    double turn = settle_at(0.0, kLoose), share = 0.0, step = kFirstShare;
    if (!(turn < kLoose)) return turn;
    while (share < 1.0) {
      const double tried = std::min(1.0, share + step), within = tried < 1.0 ? kLoose : tolerance;
      const std::vector<double> before = plain.u;
      turn = settle_at(tried, within);
      if (turn < within) {
        share = tried;
      } else {
        plain.u = before;
        step *= 0.5;
        if (step < kLeastShare) return turn;
      }
    }
    return turn;
  }

  Sweep<double> plain;

 private:
  const Batch& batch_;
  std::int64_t size_;
  Slopes<double> slopes_;
};

/// The same of kNativeLanes members, one in each lane: what one does, none of the others feels.
class SideBySide {
 public:
  explicit SideBySide(const Batch& batch)
      : plain(batch.body),
        batch_(batch),
        size_(3 * batch.body.num_elements),
        slopes_(batch.body),
        matrix_(at(size_ * size_)),
        step_(at(size_)),
        factor_(static_cast<int>(size_)) {}

  void load(int lane, const Member& m, const double* strains) {
    each_field(batch_.body, [&](int f, std::int64_t begin, std::int64_t size) {
      const double* from = part(batch_.fields[f], size, m);
      for (std::int64_t k = 0; k < size; ++k) plain.numbers[at(begin + k)][lane] = from[k];
    });
    put(strains, size_, plain.u, lane);
  }
  /// Numbers of one member into its lane, and back.
  static void put(const double* from, std::int64_t count, std::vector<Native>& to, int lane) {
    for (std::int64_t k = 0; k < count; ++k) to[at(k)][lane] = from[k];
  }
  static void get(const std::vector<Native>& from, int lane, double* to) {
    for (const Native& v : from) *to++ = v[lane];
  }

  /// Newton's method as Solver::settle has it; lanes that are done rest.
  Native settle(double tolerance) {
    const Native none{}, one = broadcast<Native>(1.0);
    const NativeMask all_lanes = none == none;
    plain.run();
    factorize(false, all_lanes);
    NativeMask is_left = all_lanes;
    Native last = none;
    for (int k = 0; k < kMostSteps && any(is_left); ++k) {
      Native turn = find_step();
      const NativeMask is_slow = is_left & ~less(turn, kGain * last);
      if (k > 0 && any(is_slow)) {
        factorize(false, is_slow);
        turn = find_step();
      }
      last = select(is_left, turn, last);
      is_left &= less(abs(turn), broadcast<Native>(std::numeric_limits<double>::infinity()));
      const Native share = keep(is_left, min(kMostTurn / turn, one));
      for (std::size_t i = 0; i < step_.size(); ++i) plain.u[i] -= keep(is_left, share * step_[i]);
      plain.run();
      is_left &= ~less(turn, broadcast<Native>(tolerance));
    }
    return last;
  }

  /// x = J^-1 b, or J'^-1 b, of the slopes J where `plain` was run; x may be b.
  void solve(bool transposed, const Native* b, Native* x) {
    factorize(transposed, Native{} == Native{});
    factor_.solve(b, x);
  }

  Sweep<Native> plain;

 private:
  static std::size_t at(std::int64_t i) { return static_cast<std::size_t>(i); }
  void factorize(bool transposed, const NativeMask& wanted) {
    slopes_.find(plain, transposed ? size_ : 1, transposed ? 1 : size_, matrix_.data());
    factor_.factor(matrix_.data(), wanted);
  }
  /// Newton's step, and its turn.
  Native find_step() {
    factor_.solve(plain.residual.data(), step_.data());
    return turn_of(plain, step_.data());
  }

  const Batch& batch_;
  std::int64_t size_;
  Slopes<Native> slopes_;
  std::vector<Native> matrix_, step_;
  LaneLu factor_;
};

Member member_of(const Batch& batch, std::int64_t i) {
  return {i / batch.columns, i % batch.columns, i};
}

/// Calls f(first, last) for the members of each task.
template <class F>
void each_task(const Batch& batch, F&& f) {
  const std::int64_t count = batch.rows * batch.columns, tasks = (count + kTask - 1) / kTask;
  ThreadPool pool(static_cast<int>(std::min<std::int64_t>(batch.num_threads, tasks)));
  pool.run_ranges(count, kTask, f);
}

/// Calls f(member, solver) for all members; a solver serves several.
template <class F>
void each_member(const Batch& batch, F&& f) {
  each_task(batch, [&](std::int64_t first, std::int64_t last) {
    Solver solver(batch);
    for (std::int64_t i = first; i < last; ++i) f(member_of(batch, i), solver);
  });
}

/// Calls side_by_side(members, solver) for as many members as there are lanes, and f as above for
/// what is left of a task.
template <class G, class F>
void each_lanes(const Batch& batch, G&& side_by_side, F&& f) {
  each_task(batch, [&](std::int64_t first, std::int64_t last) {
    Solver solver(batch);
    if (last - first >= kNativeLanes) {
      SideBySide lanes(batch);
      for (; last - first >= kNativeLanes; first += kNativeLanes) {
        Member members[kNativeLanes];
        for (int lane = 0; lane < kNativeLanes; ++lane)
          members[lane] = member_of(batch, first + lane);
        side_by_side(members, lanes, solver);
      }
    }
    for (; first < last; ++first) f(member_of(batch, first), solver);
  });
}

}  // namespace

void solve(const Batch& batch, const Settings& settings, const Rows<const double>& start,
           double* strains, double* places, double* turns) {
  const std::int64_t size = 3 * batch.body.num_elements, width = 3 * batch.body.num_points;
  const auto from_straight = [&](const Member& m, Solver& solver) {
    solver.load(m, part(start, size, m));
    return solver.settle_from_straight(settings.tolerance);
  };
  const auto give = [&](const Member& m, const Sweep<double>& sweep, double turn) {
    turns[m.index] = turn;
    std::copy(sweep.u.begin(), sweep.u.end(), strains + m.index * size);
    std::copy(sweep.places.begin(), sweep.places.end(), places + m.index * width);
  };
  const auto alone = [&](const Member& m, Solver& solver) {
    solver.load(m, part(start, size, m));
    double turn = std::numeric_limits<double>::infinity();
    if (!settings.from_straight) turn = solver.settle(settings.tolerance);
    if (!(turn < settings.tolerance)) turn = from_straight(m, solver);
    give(m, solver.plain, turn);
  };
  if (settings.from_straight) return each_member(batch, alone);
  const auto together = [&](const Member* members, SideBySide& lanes, Solver& solver) {
    for (int lane = 0; lane < kNativeLanes; ++lane)
      lanes.load(lane, members[lane], part(start, size, members[lane]));
    const Native found = lanes.settle(settings.tolerance);
    for (int lane = 0; lane < kNativeLanes; ++lane) {
      const Member& m = members[lane];
      if (found[lane] < settings.tolerance) {
        turns[m.index] = found[lane];
        SideBySide::get(lanes.plain.u, lane, strains + m.index * size);
        SideBySide::get(lanes.plain.places, lane, places + m.index * width);
      } else {
        const double turn = from_straight(m, solver);
        give(m, solver.plain, turn);
      }
    }
  };
  each_lanes(batch, together, alone);
}

// residual(u(q), q) = 0, so that with J = d residual / du
//   dL/dq = dL/dplaces dplaces/dq - l' d residual / dq,  J' l = dL/du + dL/dplaces dplaces/du.
void solve_vjp(const Batch& batch, const double* strains, const double* grad_strains,
               const double* grad_places, const Fields<double>& grads) {
  const std::int64_t size = 3 * batch.body.num_elements, width = 3 * batch.body.num_points;
  const std::int64_t count = field_places(batch.body)[kNumFields];
  std::vector<double> own(count * batch.rows * batch.columns);
  const auto together = [&](const Member* members, SideBySide& lanes, Solver&) {
    std::vector<Native> of_numbers(count), grad_u(size), of_places(width), of_residual(size);
    std::vector<Native> unused(size);
    for (int lane = 0; lane < kNativeLanes; ++lane) {
      const Member& m = members[lane];
      lanes.load(lane, m, strains + m.index * size);
      SideBySide::put(grad_strains + m.index * size, size, grad_u, lane);
      SideBySide::put(grad_places + m.index * width, width, of_places, lane);
    }
    lanes.plain.run();
    reverse(lanes.plain, of_residual.data(), of_places.data(), of_numbers.data(), grad_u.data());
    lanes.solve(true, grad_u.data(), of_residual.data());
    for (Native& v : of_residual) v = -v;
    std::fill(of_places.begin(), of_places.end(), Native{});
    reverse(lanes.plain, of_residual.data(), of_places.data(), of_numbers.data(), unused.data());
    for (int lane = 0; lane < kNativeLanes; ++lane)
      SideBySide::get(of_numbers, lane, &own[count * members[lane].index]);
  };
  const auto alone = [&](const Member& m, Solver& solver) {
    solver.load(m, strains + m.index * size);
    solver.plain.run();
    std::vector<double> grad_u(grad_strains + m.index * size, grad_strains + (m.index + 1) * size);
    std::vector<double> of_residual(size), of_places(width), unused(size);
    double* of_numbers = &own[count * m.index];
    reverse(solver.plain, of_residual.data(), grad_places + m.index * width, of_numbers,
            grad_u.data());
    const dense::VectorXd l = dense::Lu(solver.slopes(true)).solve_one(grad_u.data());
    for (std::int64_t i = 0; i < size; ++i) of_residual[i] = -l(i);
    reverse(solver.plain, of_residual.data(), of_places.data(), of_numbers, unused.data());
  };
  each_lanes(batch, together, alone);
  // shared numbers gather what their members have, whatever the number of threads
  each_field(batch.body, [&](int f, std::int64_t begin, std::int64_t length) {
    for (std::int64_t i = 0; i < batch.rows * batch.columns; ++i) {
      double* to = part(grads[f], length, {i / batch.columns, i % batch.columns, i});
      for (std::int64_t k = 0; k < length; ++k) to[k] += own[count * i + begin + k];
    }
  });
}

void solve_tangent(const Batch& batch, const Fields<const double>& directions,
                   const double* strains, double* d_strains, double* d_places) {
  const std::int64_t size = 3 * batch.body.num_elements, width = 3 * batch.body.num_points;
  each_member(batch, [&](const Member& m, Solver& solver) {
    solver.load(m, strains + m.index * size);
    solver.plain.run();
    Sweep<LaneDual> along(batch.body);  // its first lane
    along.copy(solver.plain);
    each_field(batch.body, [&](int f, std::int64_t begin, std::int64_t length) {
      const double* rate = part(directions[f], length, m);
      for (std::int64_t k = 0; k < length; ++k) along.numbers[begin + k].along[0] = rate[k];
    });
    along.run();
    dense::VectorXd moved(size);
    for (std::int64_t i = 0; i < size; ++i) moved(i) = -along.residual[i].along[0];
    const dense::VectorXd du = dense::Lu(solver.slopes(false)).solve_one(moved.data());
    for (std::int64_t i = 0; i < size; ++i)
      d_strains[m.index * size + i] = along.u[i].along[0] = du(i);
    along.run();
    for (std::int64_t i = 0; i < width; ++i)
      d_places[m.index * width + i] = along.places[i].along[0];
  });
}

void survey(const Batch& batch, const double* strains, double* frames, double* nodes,
            double* stretches, double* tensions, double* residual) {
  const std::int64_t n = batch.body.num_elements, size = 3 * n;
  const std::int64_t num_tensions = n * batch.body.num_tendons;
  each_member(batch, [&](const Member& m, Solver& solver) {
    Sweep<double>& sweep = solver.plain;
    solver.load(m, strains + m.index * size);
    sweep.run();
    std::copy(sweep.edges.begin(), sweep.edges.end(), frames + m.index * 9 * (n + 1));
    std::copy(sweep.nodes.begin(), sweep.nodes.end(), nodes + m.index * 3 * (n + 1));
    std::copy(sweep.tension.begin(), sweep.tension.end(), tensions + m.index * num_tensions);
    std::copy(sweep.residual.begin(), sweep.residual.end(), residual + m.index * size);
    for (std::int64_t i = 0; i < n; ++i)
      std::copy_n(sweep.stretch(i), 3, stretches + m.index * size + 3 * i);
  });
}

}  // namespace diffsim::rod
