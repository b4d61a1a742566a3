#include "kernels/ode/integrate.h"

#include <algorithm>

#include "kernels/linalg/aligned_buffer.h"
#include "kernels/parallel.h"

namespace diffsim {

namespace {

// Two SIMD registers a row: reading an instruction takes as long as one.
constexpr int kWide = 2 * kNativeLanes;

/// Integrates up to `Lanes` members from `first` on; lanes behind the batch repeat its last member.
///
/// Lanes do not see each other, so a member has the same bits beside any others, and alone.
template <int Lanes>
class Sweep {
 public:
  Sweep(const OdeProblem& problem, std::int64_t first, const double* inputs,
        const double* parameters, Stop& stop)
      : p_(problem),
        stop_(stop),
        first_(first),
        count_(static_cast<int>(std::min<std::int64_t>(Lanes, p_.batch - first))),
        carries_(std::none_of(p_.held, p_.held + p_.num_inputs, [](auto held) { return held; })),
        inputs_(inputs),
        registers_(p_.tape.num_registers() * Lanes),
        rates_(4 * p_.num_states * Lanes),
        widths_(p_.num_states * Lanes),
        sixths_(p_.num_states * Lanes) {
    gather(parameters, p_.num_parameters, given(1 + p_.num_states + p_.num_inputs));
    double* at = given(1 + p_.num_states + p_.num_inputs + p_.num_parameters);
    for (std::int64_t i = 0; i < p_.num_constants; ++i, at += Lanes)
      std::fill(at, at + Lanes, p_.constants[i]);
    run_tape<Lanes>(p_.tape, kFixed, registers_.data());
  }

  void forward(const double* start, double* readings, double* states) {
    std::vector<double> x(p_.num_states * Lanes);
    gather(start, p_.num_states, x.data());
    for (std::int64_t k = 0; k < p_.num_samples; ++k) {
      read(k, x.data());
      hand_out(k, x.data(), registers_.data(), states, readings);
      for (std::int64_t j = 0; j < num_steps_from(k); ++j) {
        if (stop_.asked()) return;
        step(k, j, x.data(), j == 0);
      }
    }
  }

  /// Readings and states along a direction: the steps and their tangents side by side.
  void tangent(const double* start, const double* d_start, const double* d_inputs,
               const double* d_parameters, double* d_readings, double* d_states) {
    const std::int64_t n = p_.num_states, size = n * Lanes;
    tangents_.resize(p_.tape.num_registers() * Lanes);
    std::fill_n(tangents_.data(), p_.tape.num_given * Lanes, 0.0);
    d_inputs_ = d_inputs;
    gather(d_parameters, p_.num_parameters, &tangents_.data()[(1 + n + p_.num_inputs) * Lanes]);
    tangent_tape<Lanes>(p_.tape, kFixed, registers_.data(), tangents_.data());
    std::vector<double> x(size), dx(size), d_rates(4 * size), d_stage(size);
    gather(start, n, x.data());
    gather(d_start, n, dx.data());
    for (std::int64_t k = 0; k < p_.num_samples; ++k) {
      read(k, x.data());
      move(dx.data());
      tangent_tape<Lanes>(p_.tape, kReadings, registers_.data(), tangents_.data());
      hand_out(k, dx.data(), tangents_.data(), d_states, d_readings);
      for (std::int64_t j = 0; j < num_steps_from(k); ++j) {
        if (stop_.asked()) return;
        const double* h = widths(k);
        for (int r = 0; r < 4; ++r) {
          rate(k, j, r, x.data());
          for (std::int64_t i = 0; i < size; ++i)
            d_stage[i] = dx[i] + (r > 0 ? kShare[r] * h[i] * d_rates[(r - 1) * size + i] : 0.0);
          move(d_stage.data());
          for (std::int64_t s = 0; s < n; ++s)
            std::copy_n(&tangents_.data()[p_.rate_out[s] * Lanes], Lanes,
                        &d_rates[r * size + s * Lanes]);
        }
        for (std::int64_t i = 0; i < size; ++i) {
          const double end = x[i] + advance(i);
          const bool inside = end >= p_.lower[i / Lanes] && end <= p_.upper[i / Lanes];
          double moved = dx[i];
          for (int r = 0; r < 4; ++r) moved += sixths_[i] * kWeight[r] * d_rates[r * size + i];
          dx[i] = inside ? moved : 0.0;
          x[i] = std::clamp(end, p_.lower[i / Lanes], p_.upper[i / Lanes]);
        }
      }
    }
  }

  void backward(const double* states, const double* grad_readings, const double* grad_states,
                double* grad_start, double* grad_inputs, double* grad_parameters) {
    const std::int64_t n = p_.num_states;
    adjoints_.resize(p_.tape.num_registers() * Lanes);
    std::fill_n(adjoints_.data(), p_.tape.num_registers() * Lanes, 0.0);
    std::vector<double> g(n * Lanes, 0.0), path((p_.num_steps + 1) * n * Lanes);
    grad_inputs_ = grad_inputs;
    for (std::int64_t k = p_.num_samples - 1; k >= 0; --k) {
      load(states, k, path.data());
      for (std::int64_t j = 0; j + 1 < num_steps_from(k); ++j) {
        if (stop_.asked()) return;
        std::copy_n(&path[j * n * Lanes], n * Lanes, &path[(j + 1) * n * Lanes]);
        step(k, j, &path[(j + 1) * n * Lanes]);
      }
      for (std::int64_t j = num_steps_from(k) - 1; j >= 0; --j) {
        if (stop_.asked()) return;
        reverse_step(k, j, &path[j * n * Lanes], g.data());
      }
      read(k, path.data());
      for (std::int64_t c = 0; c < p_.num_channels; ++c)
        for (int l = 0; l < count_; ++l)
          adjoints_.data()[p_.reading_out[c] * Lanes + l] +=
              grad_readings[((first_ + l) * p_.num_samples + k) * p_.num_channels + c];
      reverse(kReadings);
      reverse(kMoving);
      collect_states(g.data());
      reverse(kDriven);
      collect_inputs(k, 0.0);
      for (std::int64_t s = 0; s < n; ++s)
        for (int l = 0; l < count_; ++l)
          g[s * Lanes + l] += grad_states[((first_ + l) * p_.num_samples + k) * n + s];
    }
    reverse(kFixed);
    const double* of_parameters = &adjoints_.data()[(1 + n + p_.num_inputs) * Lanes];
    for (int l = 0; l < count_; ++l) {
      for (std::int64_t s = 0; s < n; ++s) grad_start[(first_ + l) * n + s] = g[s * Lanes + l];
      for (std::int64_t i = 0; i < p_.num_parameters; ++i)
        grad_parameters[(first_ + l) * p_.num_parameters + i] = of_parameters[i * Lanes + l];
    }
  }

 private:
  double* given(std::int64_t i) { return registers_.data() + i * Lanes; }
  std::int64_t member(int l) const { return first_ + std::min(l, count_ - 1); }
  std::int64_t num_steps_from(std::int64_t k) const {
    return k + 1 < p_.num_samples ? p_.num_steps : 0;
  }

  /// Rows of (batch, size) as registers.
  void gather(const double* rows, std::int64_t size, double* to) const {
    for (std::int64_t i = 0; i < size; ++i)
      for (int l = 0; l < Lanes; ++l) to[i * Lanes + l] = rows[member(l) * size + i];
  }

  /// Inputs, or their tangents, at a share of the interval from sample k on.
  void place_inputs(const double* inputs, std::int64_t k, double share, double* u) const {
    const std::int64_t next = std::min(k + 1, p_.num_samples - 1);
    for (std::int64_t i = 0; i < p_.num_inputs; ++i)
      for (int l = 0; l < Lanes; ++l) {
        const double* own = inputs + member(l) * p_.input_stride;
        const double now = own[k * p_.num_inputs + i];
        const double then = own[next * p_.num_inputs + i];
        u[i * Lanes + l] = p_.held[i] ? now : now + share * (then - now);
      }
  }

  /// Time and inputs at a share of the interval from sample k on, and what they drive; nothing
  /// where they are there already.
  void drive(std::int64_t k, double share) {
    if (carries_ && share == 1.0) ++k, share = 0.0;
    if (k == driven_from_ && share == driven_share_) return;
    driven_from_ = k, driven_share_ = share;
    const std::int64_t next = std::min(k + 1, p_.num_samples - 1);
    const auto now = [&](int l) { return time(k, l) + share * (time(next, l) - time(k, l)); };
    if (p_.time_stride == 0)
      std::fill_n(given(0), Lanes, now(0));
    else
      for (int l = 0; l < Lanes; ++l) given(0)[l] = now(l);
    place_inputs(inputs_, k, share, given(1 + p_.num_states));
    run_tape<Lanes>(p_.tape, kDriven, registers_.data());
    if (tangents_.data() == nullptr) return;
    place_inputs(d_inputs_, k, share, &tangents_.data()[(1 + p_.num_states) * Lanes]);
    tangent_tape<Lanes>(p_.tape, kDriven, registers_.data(), tangents_.data());
  }

  /// Tangents of the rates along those of the states, where both are evaluated.
  void move(const double* dx) {
    std::copy_n(dx, p_.num_states * Lanes, &tangents_.data()[Lanes]);
    tangent_tape<Lanes>(p_.tape, kMoving, registers_.data(), tangents_.data());
  }

  void read(std::int64_t k, const double* x) {
    drive(k, 0.0);
    std::copy_n(x, p_.num_states * Lanes, given(1));
    run_tape<Lanes>(p_.tape, kMoving, registers_.data());
    run_tape<Lanes>(p_.tape, kReadings, registers_.data());
  }

  /// States and readings at sample k, or their tangents, as rows of the batch.
  void hand_out(std::int64_t k, const double* x, const double* registers, double* states,
                double* readings) const {
    for (int l = 0; l < count_; ++l) {
      const std::int64_t row = (first_ + l) * p_.num_samples + k;
      for (std::int64_t s = 0; s < p_.num_states; ++s)
        states[row * p_.num_states + s] = x[s * Lanes + l];
      for (std::int64_t c = 0; c < p_.num_channels; ++c)
        readings[row * p_.num_channels + c] = registers[p_.reading_out[c] * Lanes + l];
    }
  }

  /// Where stage r (0 to 3) of step j lies between sample k and the next.
  double share(std::int64_t j, int r) const {
    return (static_cast<double>(j) + kShare[r]) / static_cast<double>(p_.num_steps);
  }

  /// Rates at stage r of step j into `rates_`; registers are left as the tape filled them.
  /// @param x  state at the step's start
  void rate(std::int64_t k, std::int64_t j, int r, const double* x) {
    const std::int64_t size = p_.num_states * Lanes;
    drive(k, share(j, r));
    double* at = given(1);
    if (r == 0) {
      std::copy_n(x, size, at);
    } else {
      const double* before = &rates_[(r - 1) * size];
      const double* h = widths(k);
      for (std::int64_t i = 0; i < size; ++i) at[i] = x[i] + kShare[r] * h[i] * before[i];
    }
    run_tape<Lanes>(p_.tape, kMoving, registers_.data());
    keep_rates(r);
  }
  void keep_rates(int r) {
    for (std::int64_t s = 0; s < p_.num_states; ++s)
      std::copy_n(given(p_.rate_out[s]), Lanes, &rates_[(r * p_.num_states + s) * Lanes]);
  }

  double time(std::int64_t k, int l) const { return p_.times[member(l) * p_.time_stride + k]; }

  /// Lengths of the steps between sample k and the next, for each state of each lane.
  const double* widths(std::int64_t k) {
    if (k == wide_from_) return widths_.data();
    wide_from_ = k;
    double h = 0.0, sixth = 0.0;
    for (int l = 0; l < Lanes; ++l) {
      if (l == 0 || p_.time_stride > 0) {
        h = (time(k + 1, l) - time(k, l)) / static_cast<double>(p_.num_steps);
        sixth = h / 6.0;
      }
      for (std::int64_t i = l; i < p_.num_states * Lanes; i += Lanes)
        widths_[i] = h, sixths_[i] = sixth;
    }
    return widths_.data();
  }

  /// @param is_read  whether `read` has just evaluated the start of the step
  void step(std::int64_t k, std::int64_t j, double* x, bool is_read = false) {
    widths(k);
    if (is_read)
      keep_rates(0);
    else
      rate(k, j, 0, x);
    for (int r = 1; r < 4; ++r) rate(k, j, r, x);
    for (std::int64_t s = 0; s < p_.num_states; ++s)
      for (int l = 0; l < Lanes; ++l) {
        const std::int64_t i = s * Lanes + l;
        const double end = x[i] + advance(i);
        x[i] = std::clamp(end, p_.lower[s], p_.upper[s]);
      }
  }

  double advance(std::int64_t i) const {
    const std::int64_t size = p_.num_states * Lanes;
    return sixths_[i] *
           (rates_[i] + 2.0 * rates_[size + i] + 2.0 * rates_[2 * size + i] + rates_[3 * size + i]);
  }

  /// dL/d(state after step j) -> dL/d(state before it), in place.
  void reverse_step(std::int64_t k, std::int64_t j, const double* x, double* g) {
    const double* h = widths(k);
    const std::int64_t size = p_.num_states * Lanes;
    for (int r = 0; r < 4; ++r) rate(k, j, r, x);
    for (std::int64_t i = 0; i < size; ++i) {
      const double end = x[i] + advance(i);
      if (end < p_.lower[i / Lanes] || end > p_.upper[i / Lanes]) g[i] = 0.0;
    }
    // dL/d(rates of stage r), stages from the last one back: x_r = x + share_r h rate_(r-1)
    std::vector<double> of_rate(4 * size), before(size);
    for (int r = 0; r < 4; ++r)
      for (std::int64_t i = 0; i < size; ++i)
        of_rate[r * size + i] = sixths_[i] * kWeight[r] * g[i];
    for (int r = 3; r >= 0; --r) {
      if (r < 3) rate(k, j, r, x);
      for (std::int64_t s = 0; s < p_.num_states; ++s)
        for (int l = 0; l < Lanes; ++l)
          adjoints_.data()[p_.rate_out[s] * Lanes + l] += of_rate[r * size + s * Lanes + l];
      reverse(kMoving);
      std::fill(before.begin(), before.end(), 0.0);
      collect_states(before.data());
      if (r != 2) {  // stages 1 and 2 are driven alike
        reverse(kDriven);
        collect_inputs(k, share(j, r));
      }
      for (std::int64_t i = 0; i < size; ++i) {
        g[i] += before[i];
        if (r > 0) of_rate[(r - 1) * size + i] += kShare[r] * h[i] * before[i];
      }
    }
  }

  void reverse(TapePart part) {
    reverse_tape<Lanes>(p_.tape, part, registers_.data(), adjoints_.data());
  }

  /// Adds adjoints of the states to `g`; those of the parameters stay and sum up.
  void collect_states(double* g) {
    double* own = adjoints_.data() + Lanes;
    for (std::int64_t i = 0; i < p_.num_states * Lanes; ++i) g[i] += own[i];
    std::fill_n(own, p_.num_states * Lanes, 0.0);
  }

  /// Hands adjoints of the inputs to the samples around.
  void collect_inputs(std::int64_t k, double share) {
    const std::int64_t next = std::min(k + 1, p_.num_samples - 1);
    double* of_inputs = adjoints_.data() + (1 + p_.num_states) * Lanes;
    for (std::int64_t i = 0; i < p_.num_inputs; ++i)
      for (int l = 0; l < count_; ++l) {
        const double a = of_inputs[i * Lanes + l];
        double* own = grad_inputs_ + (first_ + l) * p_.num_samples * p_.num_inputs;
        own[k * p_.num_inputs + i] += p_.held[i] ? a : (1.0 - share) * a;
        own[next * p_.num_inputs + i] += p_.held[i] ? 0.0 : share * a;
      }
    std::fill_n(of_inputs, p_.num_inputs * Lanes, 0.0);
  }

  void load(const double* states, std::int64_t k, double* x) const {
    for (std::int64_t s = 0; s < p_.num_states; ++s)
      for (int l = 0; l < Lanes; ++l)
        x[s * Lanes + l] = states[(member(l) * p_.num_samples + k) * p_.num_states + s];
  }

  // classical Runge-Kutta: where stages lie in a step, and their weights times 6
  static constexpr double kShare[4] = {0.0, 0.5, 0.5, 1.0};
  static constexpr double kWeight[4] = {1.0, 2.0, 2.0, 1.0};

  const OdeProblem& p_;
  Stop& stop_;
  std::int64_t first_;
  int count_;     // lanes that are members
  bool carries_;  // whether an interval's end is the next one's begin: no input is held
  const double* inputs_;
  double* grad_inputs_ = nullptr;
  const double* d_inputs_ = nullptr;
  std::int64_t driven_from_ = -1;  // sample and share that `drive` was called for
  double driven_share_ = 0.0;
  std::int64_t wide_from_ = -1;  // sample that `widths_` were made for
  AlignedBuffer<double> registers_, adjoints_, tangents_;
  std::vector<double> rates_, widths_, sixths_;
};

/// Calls f with the width and first member of every group; groups do not depend on the threads.
template <typename F>
void each_group(std::int64_t batch, int num_threads, F&& f) {
  const std::int64_t rest = batch % kWide;
  const bool has_few = rest > 0 && rest <= kNativeLanes;  // one SIMD register holds what is left
  const std::int64_t wide = batch / kWide + (rest > 0 && !has_few), count = wide + has_few;
  ThreadPool pool(static_cast<int>(std::min<std::int64_t>(num_threads, count)));
  pool.run(count, [&](std::int64_t i) {
    if (i < wide)
      f(std::integral_constant<int, kWide>(), i * kWide);
    else
      f(std::integral_constant<int, kNativeLanes>(), i * kWide);
  });
}

}  // namespace

void integrate(const OdeProblem& problem, const double* start, const double* inputs,
               const double* parameters, double* readings, double* states, int num_threads,
               Stop& stop) {
  each_group(problem.batch, num_threads, [&](auto lanes, std::int64_t first) {
    Sweep<decltype(lanes)::value>(problem, first, inputs, parameters, stop)
        .forward(start, readings, states);
  });
}

void integrate_vjp(const OdeProblem& problem, const double* inputs, const double* parameters,
                   const double* states, const double* grad_readings, const double* grad_states,
                   double* grad_start, double* grad_inputs, double* grad_parameters,
                   int num_threads, Stop& stop) {
  std::fill_n(grad_inputs, problem.batch * problem.num_samples * problem.num_inputs, 0.0);
  each_group(problem.batch, num_threads, [&](auto lanes, std::int64_t first) {
    Sweep<decltype(lanes)::value>(problem, first, inputs, parameters, stop)
        .backward(states, grad_readings, grad_states, grad_start, grad_inputs, grad_parameters);
  });
}

void integrate_tangent(const OdeProblem& problem, const double* start, const double* inputs,
                       const double* parameters, const double* d_start, const double* d_inputs,
                       const double* d_parameters, double* d_readings, double* d_states,
                       int num_threads, Stop& stop) {
  each_group(problem.batch, num_threads, [&](auto lanes, std::int64_t first) {
    Sweep<decltype(lanes)::value>(problem, first, inputs, parameters, stop)
        .tangent(start, d_start, d_inputs, d_parameters, d_readings, d_states);
  });
}

}  // namespace diffsim
