#include "kernels/ode/integrate.h"

#include <algorithm>

#include "kernels/parallel.h"

namespace diffsim {

namespace {

// Members of a batch side by side in one sweep; what is left of a batch goes by fours, twos and
// ones. All give the same bits: lanes do not see each other.
constexpr int kLanes = 8;

/// Integrates `Lanes` members from `first` on.
template <int Lanes>
class Sweep {
 public:
  Sweep(const OdeProblem& problem, std::int64_t first, const double* inputs,
        const double* parameters, Stop& stop)
      : p_(problem),
        stop_(stop),
        first_(first),
        inputs_(inputs),
        registers_(std::max(p_.rates.num_registers(), p_.readings.num_registers()) * Lanes),
        rates_(4 * p_.num_states * Lanes),
        stage_(p_.num_states * Lanes) {
    double* at = given(1 + p_.num_states + p_.num_inputs);
    for (std::int64_t i = 0; i < p_.num_parameters; ++i, at += Lanes)
      for (int l = 0; l < Lanes; ++l) at[l] = parameters[(first + l) * p_.num_parameters + i];
    for (std::int64_t i = 0; i < p_.num_constants; ++i, at += Lanes)
      std::fill(at, at + Lanes, p_.constants[i]);
  }

  void forward(const double* start, double* readings, double* states) {
    std::vector<double> x(p_.num_states * Lanes);
    for (std::int64_t s = 0; s < p_.num_states; ++s)
      for (int l = 0; l < Lanes; ++l) x[s * Lanes + l] = start[(first_ + l) * p_.num_states + s];
    for (std::int64_t k = 0; k < p_.num_samples; ++k) {
      for (int l = 0; l < Lanes; ++l)
        for (std::int64_t s = 0; s < p_.num_states; ++s)
          states[((first_ + l) * p_.num_samples + k) * p_.num_states + s] = x[s * Lanes + l];
      read(k, x.data());
      for (int l = 0; l < Lanes; ++l)
        for (std::int64_t c = 0; c < p_.num_channels; ++c)
          readings[((first_ + l) * p_.num_samples + k) * p_.num_channels + c] =
              registers_[p_.reading_out[c] * Lanes + l];
      if (k + 1 == p_.num_samples) break;
      for (std::int64_t j = 0; j < p_.num_steps; ++j) {
        if (stop_.asked()) return;
        step(k, j, x.data());
      }
    }
  }

  /// Readings and states along a direction: the steps and their tangents side by side.
  void tangent(const double* start, const double* d_start, const double* d_inputs,
               const double* d_parameters, double* d_readings, double* d_states) {
    const std::int64_t n = p_.num_states, size = n * Lanes;
    tangents_.assign(registers_.size(), 0.0);
    d_inputs_ = d_inputs;
    for (std::int64_t i = 0; i < p_.num_parameters; ++i)
      for (int l = 0; l < Lanes; ++l)
        tangents_[(1 + n + p_.num_inputs + i) * Lanes + l] =
            d_parameters[(first_ + l) * p_.num_parameters + i];
    std::vector<double> x(size), dx(size), d_rates(4 * size), d_stage(size);
    for (std::int64_t s = 0; s < n; ++s)
      for (int l = 0; l < Lanes; ++l) {
        x[s * Lanes + l] = start[(first_ + l) * n + s];
        dx[s * Lanes + l] = d_start[(first_ + l) * n + s];
      }
    for (std::int64_t k = 0; k < p_.num_samples; ++k) {
      read(k, x.data());
      place_tangent(k, 0.0, dx.data());
      tangent_tape<Lanes>(p_.readings, registers_.data(), tangents_.data());
      for (int l = 0; l < Lanes; ++l) {
        const std::int64_t row = (first_ + l) * p_.num_samples + k;
        for (std::int64_t s = 0; s < n; ++s) d_states[row * n + s] = dx[s * Lanes + l];
        for (std::int64_t c = 0; c < p_.num_channels; ++c)
          d_readings[row * p_.num_channels + c] = tangents_[p_.reading_out[c] * Lanes + l];
      }
      if (k + 1 == p_.num_samples) break;
      const double h = width(k), steps = static_cast<double>(p_.num_steps);
      for (std::int64_t j = 0; j < p_.num_steps; ++j) {
        if (stop_.asked()) return;
        for (int r = 0; r < 4; ++r) {
          rate(k, j, r, stage(r, h, x.data()));
          for (std::int64_t i = 0; i < size; ++i)
            d_stage[i] = dx[i] + (r > 0 ? kShare[r] * h * d_rates[(r - 1) * size + i] : 0.0);
          place_tangent(k, (static_cast<double>(j) + kShare[r]) / steps, d_stage.data());
          tangent_tape<Lanes>(p_.rates, registers_.data(), tangents_.data());
          for (std::int64_t s = 0; s < n; ++s)
            std::copy_n(&tangents_[p_.rate_out[s] * Lanes], Lanes, &d_rates[r * size + s * Lanes]);
        }
        for (std::int64_t i = 0; i < size; ++i) {
          const double end = x[i] + advance(h, i);
          const bool inside = end >= p_.lower[i / Lanes] && end <= p_.upper[i / Lanes];
          double moved = dx[i];
          for (int r = 0; r < 4; ++r) moved += h / 6.0 * kWeight[r] * d_rates[r * size + i];
          dx[i] = inside ? moved : 0.0;
          x[i] = std::clamp(end, p_.lower[i / Lanes], p_.upper[i / Lanes]);
        }
      }
    }
  }

  void backward(const double* states, const double* grad_readings, const double* grad_states,
                double* grad_start, double* grad_inputs, double* grad_parameters) {
    const std::int64_t n = p_.num_states;
    adjoints_.assign(registers_.size(), 0.0);
    std::vector<double> g(n * Lanes, 0.0), path((p_.num_steps + 1) * n * Lanes);
    grad_inputs_ = grad_inputs;
    for (std::int64_t k = p_.num_samples - 1; k >= 0; --k) {
      if (k + 1 < p_.num_samples) {
        load(states, k, path.data());
        for (std::int64_t j = 0; j + 1 < p_.num_steps; ++j) {
          if (stop_.asked()) return;
          std::copy_n(&path[j * n * Lanes], n * Lanes, &path[(j + 1) * n * Lanes]);
          step(k, j, &path[(j + 1) * n * Lanes]);
        }
        for (std::int64_t j = p_.num_steps - 1; j >= 0; --j) {
          if (stop_.asked()) return;
          reverse_step(k, j, &path[j * n * Lanes], g.data());
        }
      }
      load(states, k, path.data());
      read(k, path.data());
      for (std::int64_t c = 0; c < p_.num_channels; ++c)
        for (int l = 0; l < Lanes; ++l)
          adjoints_[p_.reading_out[c] * Lanes + l] +=
              grad_readings[((first_ + l) * p_.num_samples + k) * p_.num_channels + c];
      reverse_tape<Lanes>(p_.readings, registers_.data(), adjoints_.data());
      collect(g.data(), 1.0, k, 0.0);
      for (std::int64_t s = 0; s < n; ++s)
        for (int l = 0; l < Lanes; ++l)
          g[s * Lanes + l] += grad_states[((first_ + l) * p_.num_samples + k) * n + s];
    }
    for (int l = 0; l < Lanes; ++l) {
      for (std::int64_t s = 0; s < n; ++s) grad_start[(first_ + l) * n + s] = g[s * Lanes + l];
      for (std::int64_t i = 0; i < p_.num_parameters; ++i)
        grad_parameters[(first_ + l) * p_.num_parameters + i] =
            adjoints_[(1 + n + p_.num_inputs + i) * Lanes + l];
    }
  }

 private:
  double* given(std::int64_t i) { return &registers_[i * Lanes]; }

  /// Time, state and inputs at a share of the interval from sample k on.
  void place(std::int64_t k, double share, const double* x) {
    const std::int64_t next = std::min(k + 1, p_.num_samples - 1);
    std::fill_n(given(0), Lanes, p_.times[k] + share * (p_.times[next] - p_.times[k]));
    std::copy_n(x, p_.num_states * Lanes, given(1));
    double* u = given(1 + p_.num_states);
    for (std::int64_t i = 0; i < p_.num_inputs; ++i)
      for (int l = 0; l < Lanes; ++l) {
        const double* own = inputs_ + (first_ + l) * p_.input_stride;
        const double now = own[k * p_.num_inputs + i];
        const double then = own[next * p_.num_inputs + i];
        u[i * Lanes + l] = p_.held[i] ? now : now + share * (then - now);
      }
  }

  /// Tangents of what `place` sets; time does not move.
  void place_tangent(std::int64_t k, double share, const double* dx) {
    const std::int64_t next = std::min(k + 1, p_.num_samples - 1);
    std::copy_n(dx, p_.num_states * Lanes, &tangents_[Lanes]);
    double* du = &tangents_[(1 + p_.num_states) * Lanes];
    for (std::int64_t i = 0; i < p_.num_inputs; ++i)
      for (int l = 0; l < Lanes; ++l) {
        const double* own = d_inputs_ + (first_ + l) * p_.input_stride;
        const double now = own[k * p_.num_inputs + i];
        const double then = own[next * p_.num_inputs + i];
        du[i * Lanes + l] = p_.held[i] ? now : now + share * (then - now);
      }
  }

  void read(std::int64_t k, const double* x) {
    place(k, 0.0, x);
    run_tape<Lanes>(p_.readings, registers_.data());
  }

  /// Rates at stage r (0 to 3) of step j into `rates_`; registers are left as the tape filled them.
  void rate(std::int64_t k, std::int64_t j, int r, const double* x) {
    const double steps = static_cast<double>(p_.num_steps);
    place(k, (static_cast<double>(j) + kShare[r]) / steps, x);
    run_tape<Lanes>(p_.rates, registers_.data());
    for (std::int64_t s = 0; s < p_.num_states; ++s)
      std::copy_n(&registers_[p_.rate_out[s] * Lanes], Lanes,
                  &rates_[(r * p_.num_states + s) * Lanes]);
  }

  double width(std::int64_t k) const {
    return (p_.times[k + 1] - p_.times[k]) / static_cast<double>(p_.num_steps);
  }

  /// State at which stage r is evaluated, from that of the step's start and the rates so far.
  const double* stage(int r, double h, const double* x) {
    if (r == 0) return x;
    const double* before = &rates_[(r - 1) * p_.num_states * Lanes];
    for (std::int64_t i = 0; i < p_.num_states * Lanes; ++i)
      stage_[i] = x[i] + kShare[r] * h * before[i];
    return stage_.data();
  }

  void step(std::int64_t k, std::int64_t j, double* x) {
    const double h = width(k);
    const std::int64_t size = p_.num_states * Lanes;
    for (int r = 0; r < 4; ++r) rate(k, j, r, stage(r, h, x));
    for (std::int64_t i = 0; i < size; ++i) {
      const double end = x[i] + advance(h, i);
      x[i] = std::clamp(end, p_.lower[i / Lanes], p_.upper[i / Lanes]);
    }
  }

  double advance(double h, std::int64_t i) const {
    const std::int64_t size = p_.num_states * Lanes;
    return h / 6.0 *
           (rates_[i] + 2.0 * rates_[size + i] + 2.0 * rates_[2 * size + i] + rates_[3 * size + i]);
  }

  /// dL/d(state after step j) -> dL/d(state before it), in place.
  void reverse_step(std::int64_t k, std::int64_t j, const double* x, double* g) {
    const double h = width(k);
    const std::int64_t size = p_.num_states * Lanes;
    for (int r = 0; r < 4; ++r) rate(k, j, r, stage(r, h, x));
    for (std::int64_t i = 0; i < size; ++i) {
      const double end = x[i] + advance(h, i);
      if (end < p_.lower[i / Lanes] || end > p_.upper[i / Lanes]) g[i] = 0.0;
    }
    // dL/d(rates of stage r), stages from the last one back: x_r = x + share_r h rate_(r-1)
    std::vector<double> of_rate(4 * size), before(size);
    for (int r = 0; r < 4; ++r)
      for (std::int64_t i = 0; i < size; ++i) of_rate[r * size + i] = h / 6.0 * kWeight[r] * g[i];
    const double steps = static_cast<double>(p_.num_steps);
    for (int r = 3; r >= 0; --r) {
      rate(k, j, r, stage(r, h, x));
      for (std::int64_t s = 0; s < p_.num_states; ++s)
        for (int l = 0; l < Lanes; ++l)
          adjoints_[p_.rate_out[s] * Lanes + l] += of_rate[r * size + s * Lanes + l];
      reverse_tape<Lanes>(p_.rates, registers_.data(), adjoints_.data());
      std::fill(before.begin(), before.end(), 0.0);
      collect(before.data(), 1.0, k, (static_cast<double>(j) + kShare[r]) / steps);
      for (std::int64_t i = 0; i < size; ++i) {
        g[i] += before[i];
        if (r > 0) of_rate[(r - 1) * size + i] += kShare[r] * h * before[i];
      }
    }
  }

  /// Adds adjoints of the states to `g`, hands those of the inputs to the samples around; those of
  /// the parameters stay and sum up.
  void collect(double* g, double factor, std::int64_t k, double share) {
    const std::int64_t n = p_.num_states, next = std::min(k + 1, p_.num_samples - 1);
    for (std::int64_t i = 0; i < n * Lanes; ++i) g[i] += factor * adjoints_[Lanes + i];
    for (std::int64_t i = 0; i < p_.num_inputs; ++i)
      for (int l = 0; l < Lanes; ++l) {
        const double a = adjoints_[(1 + n + i) * Lanes + l];
        double* own = grad_inputs_ + (first_ + l) * p_.num_samples * p_.num_inputs;
        own[k * p_.num_inputs + i] += p_.held[i] ? a : (1.0 - share) * a;
        own[next * p_.num_inputs + i] += p_.held[i] ? 0.0 : share * a;
      }
    std::fill_n(adjoints_.begin(), (1 + n + p_.num_inputs) * Lanes, 0.0);
  }

  void load(const double* states, std::int64_t k, double* x) const {
    for (std::int64_t s = 0; s < p_.num_states; ++s)
      for (int l = 0; l < Lanes; ++l)
        x[s * Lanes + l] = states[((first_ + l) * p_.num_samples + k) * p_.num_states + s];
  }

  // classical Runge-Kutta: where stages lie in a step, and their weights times 6
  static constexpr double kShare[4] = {0.0, 0.5, 0.5, 1.0};
  static constexpr double kWeight[4] = {1.0, 2.0, 2.0, 1.0};

  const OdeProblem& p_;
  Stop& stop_;
  std::int64_t first_;
  const double* inputs_;
  double* grad_inputs_ = nullptr;
  const double* d_inputs_ = nullptr;
  std::vector<double> registers_, rates_, stage_, adjoints_, tangents_;
};

/// Calls f with the width and first member of every group; groups do not depend on the threads.
template <typename F>
void each_group(std::int64_t batch, int num_threads, F&& f) {
  const std::int64_t wide = batch / kLanes, rest = batch % kLanes;
  const std::int64_t four = rest / 4, two = rest % 4 / 2, count = wide + four + two + rest % 2;
  ThreadPool pool(static_cast<int>(std::min<std::int64_t>(num_threads, count)));
  pool.run(count, [&](std::int64_t i) {
    const std::int64_t first = wide * kLanes;
    if (i < wide)
      f(std::integral_constant<int, kLanes>(), i * kLanes);
    else if (i < wide + four)
      f(std::integral_constant<int, 4>(), first);
    else if (i < wide + four + two)
      f(std::integral_constant<int, 2>(), first + 4 * four);
    else
      f(std::integral_constant<int, 1>(), first + 4 * four + 2 * two);
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
