// One register's vehicles: rows in and out, the commands of a control step, one step of
// Runge-Kutta, and the adjoint of each.
#pragma once

#include <vector>

#include "kernels/copter/flight_body.h"
#include "kernels/copter/flight_feedback.h"

namespace diffsim::flight {

/// The vehicles of one register; missing ones repeat the last one and are never written.
struct Crew {
  std::int64_t first = 0, group = 0;
  int count = 0;
  std::int64_t vehicle(int lane) const { return first + (lane < count ? lane : count - 1); }
};

inline void load_row(const FlightRows& rows, const Crew& crew, std::int64_t step, int width,
                     V* out) {
  const double* row = rows.data + step * rows.step_stride;
  if (rows.vehicle_stride == 0) {
    for (int k = 0; k < width; ++k) out[k] = broadcast<V>(row[k]);
    return;
  }
  for (int lane = 0; lane < kNativeLanes; ++lane) {
    const double* of_lane = row + crew.vehicle(lane) * rows.vehicle_stride;
    for (int k = 0; k < width; ++k) out[k][lane] = of_lane[k];
  }
}

inline void add_row(const FlightGrads& grads, const Crew& crew, std::int64_t step, int width,
                    const V* values) {
  double* row = grads.data + step * grads.step_stride;
  for (int lane = 0; lane < crew.count; ++lane) {
    double* of_lane = row + (grads.shared ? crew.group : crew.first + lane) * grads.stride;
    for (int k = 0; k < width; ++k) of_lane[k] += values[k][lane];
  }
}

/// Rows of the inputs as lanes.
struct Rows {
  using Value = V;
  const FlightInputs& inputs;
  const Crew& crew;
  void load(FlightRows FlightInputs::* which, std::int64_t step, int width, V* out) const {
    load_row(inputs.*which, crew, step, width, out);
  }
};

/// One register's vehicles: their parameters, and what a step needs. `Source` gives the rows of the
/// inputs, and says of which type T the numbers are.
template <class Source>
class Flying {
 public:
  using T = typename Source::Value;

  Flying(int num_rotors, const FlightOptions& options, const Source& rows)
      : at_(num_rotors), n_(num_rotors), on_(options), rows_(rows), P_(u(at_.size)) {
    rows_.load(&FlightInputs::parameters, 0, at_.size, P_.data());
    if (on_.feedback) {
      K_.resize(static_cast<std::size_t>(n_) * kFeedback);
      rows_.load(&FlightInputs::gain, 0, n_ * kFeedback, K_.data());
    }
  }

  /// Commands of a control step before and after the clamp, and the wind.
  void command(std::int64_t step, const T* x) {
    rows_.load(&FlightInputs::feed_forward, step, n_, wanted_);
    rows_.load(&FlightInputs::wind, step, 3, wind_);
    if (on_.feedback) {
      T x12[kFeedback], reference[kFeedback];
      rows_.load(&FlightInputs::reference, step, kFeedback, reference);
      feedback_state(x, feedback_, x12);
      feedback_error(x12, reference, error_);
      for (int i = 0; i < n_; ++i) {
        for (int k = 0; k < kFeedback; ++k) wanted_[i] -= K_[u(kFeedback * i + k)] * error_[k];
      }
    }
    for (int i = 0; i < n_; ++i) {
      command_[i] = wanted_[i];
      if (on_.free_thrusts) continue;
      command_[i] = min(max(wanted_[i], T{}), P_[u(at_.max_thrusts + i)]);
    }
  }

  /// Thrust states at the middle and the end of a step from those at its start: the exact answer of
  /// tau s' = command - s.
  void lag(const T* start, T* middle, T* end) const {
    for (int i = 0; i < n_; ++i) {
      const T decay = P_[u(at_.lag_decay + i)], gap = start[i] - command_[i];
      middle[i] = command_[i] + decay * gap;
      end[i] = command_[i] + decay * decay * gap;
    }
  }

  /// One step of integration; x holds the body and, behind it, the thrust states.
  void step(T* x) {
    T middle[kMaxRotors], end[kMaxRotors];
    const T *s0 = x + kBody, *s1 = command_, *s2 = command_;
    if (on_.motor_lag) {
      lag(s0, middle, end);
      s1 = middle;
      s2 = end;
    } else {
      s0 = command_;
    }
    stages(x, s0, s1, s2);
    for (int k = 0; k < kBody; ++k) {
      x[k] += on_.dt / 6.0 * (k_[0][k] + 2.0 * (k_[1][k] + k_[2][k]) + k_[3][k]);
    }
    for (int i = 0; i < n_; ++i) x[kBody + i] = s2[i];
    const T scale = 1.0 / sqrt(norm2(x + kQuaternion));
    for (int k = 0; k < 4; ++k) x[kQuaternion + k] *= scale;
  }

  int record() const { return kBody + n_; }
  const FlightLayout& layout() const { return at_; }

 protected:
  static std::size_t u(int i) { return static_cast<std::size_t>(i); }
  static T norm2(const T* q) { return q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]; }
  double reach_of(int stage) const { return stage == 2 ? on_.dt : 0.5 * on_.dt; }

  void stages(const T* x, const T* s0, const T* s1, const T* s2) {
    const T* thrusts[4] = {s0, s1, s1, s2};
    for (int k = 0; k < kBody; ++k) stage_[0][k] = x[k];
    for (int i = 0; i < 4; ++i) {
      body_derivative(at_, on_, P_.data(), stage_[i], thrusts[i], wind_, trace_[i], k_[i]);
      if (i == 3) break;
      for (int k = 0; k < kBody; ++k) stage_[i + 1][k] = x[k] + reach_of(i) * k_[i][k];
    }
  }

  FlightLayout at_;
  int n_;
  const FlightOptions& on_;
  Source rows_;
  std::vector<T> P_, K_;
  T wanted_[kMaxRotors], command_[kMaxRotors], wind_[3], error_[kFeedback];
  FeedbackTrace<T> feedback_;
  T stage_[4][kBody], k_[4][kBody];
  BodyTrace<T> trace_[4];
};

/// The vehicles with the adjoints of what they do.
class Flight : public Flying<Rows> {
 public:
  Flight(int num_rotors, const FlightOptions& options, const FlightInputs& inputs, const Crew& crew)
      : Flying(num_rotors, options, Rows{inputs, crew}) {}

  /// Adjoint of command(); grad_command is overwritten.
  void command_vjp(std::int64_t step, const V* x, V* grad_command, const V* grad_wind, V* grad_x,
                   V* grad_P, V* grad_K, const FlightInputGrads& grads) {
    for (int i = 0; i < n_ && !on_.free_thrusts; ++i) {
      const MaskOf<V> high = greater(wanted_[i], P_[u(at_.max_thrusts + i)]);
      grad_P[at_.max_thrusts + i] += keep<V>(high, grad_command[i]);
      const MaskOf<V> inside = ~high & ~less(wanted_[i], V{});
      grad_command[i] = keep<V>(inside, grad_command[i]);
    }
    add_row(grads.feed_forward, rows_.crew, step, n_, grad_command);
    add_row(grads.wind, rows_.crew, step, 3, grad_wind);
    if (!on_.feedback) return;
    V grad_error[kFeedback] = {}, grad_reference[kFeedback];
    for (int i = 0; i < n_; ++i) {
      for (int k = 0; k < kFeedback; ++k) {
        grad_error[k] -= K_[u(kFeedback * i + k)] * grad_command[i];
        grad_K[kFeedback * i + k] -= grad_command[i] * error_[k];
      }
    }
    for (int k = 0; k < kFeedback; ++k) grad_reference[k] = -grad_error[k];
    add_row(grads.reference, rows_.crew, step, kFeedback, grad_reference);
    feedback_state_vjp(x, feedback_, grad_error, grad_x);
  }

  void lag_vjp(const V* start, const V* grad_middle, const V* grad_end, V* grad_start,
               V* grad_command, V* grad_P) const {
    for (int i = 0; i < n_; ++i) {
      const V decay = P_[u(at_.lag_decay + i)], gap = start[i] - command_[i];
      const V grad_gap = decay * (grad_middle[i] + decay * grad_end[i]);
      grad_command[i] += grad_middle[i] + grad_end[i] - grad_gap;
      grad_start[i] += grad_gap;
      grad_P[at_.lag_decay + i] += gap * (grad_middle[i] + 2.0 * decay * grad_end[i]);
    }
  }

  /// Adjoint of step(): grad_x is that of its result when called, of its start afterwards.
  void step_vjp(const V* start, V* grad_x, V* grad_command, V* grad_wind, V* grad_P) {
    V middle[kMaxRotors], end[kMaxRotors];
    V grad_s[3][kMaxRotors] = {};
    const V *s0 = command_, *s1 = command_, *s2 = command_;
    if (on_.motor_lag) {
      lag(start + kBody, middle, end);
      s0 = start + kBody;
      s1 = middle;
      s2 = end;
    }
    for (int i = 0; i < n_; ++i) grad_s[2][i] = grad_x[kBody + i];
    stages(start, s0, s1, s2);
    normalize_vjp(start, grad_x + kQuaternion);

    const double weight[4] = {on_.dt / 6.0, on_.dt / 3.0, on_.dt / 3.0, on_.dt / 6.0};
    const V* stage_thrust[4] = {s0, s1, s1, s2};
    V* grad_thrust[4] = {grad_s[0], grad_s[1], grad_s[1], grad_s[2]};
    V grad_start[kBody], grad_stage[kBody] = {};
    for (int k = 0; k < kBody; ++k) grad_start[k] = grad_x[k];
    for (int stage = 3; stage >= 0; --stage) {
      // stage_[i + 1] = start + reach_i k_i, so the stage above has sent its gradient down
      const double reach = stage == 3 ? 0.0 : reach_of(stage);
      V grad_k[kBody];
      for (int k = 0; k < kBody; ++k) {
        grad_k[k] = weight[stage] * grad_x[k] + reach * grad_stage[k];
        grad_stage[k] = V{};
      }
      body_derivative_vjp(at_, on_, P_.data(), stage_[stage], stage_thrust[stage], trace_[stage],
                          grad_k, grad_stage, grad_thrust[stage], grad_wind, grad_P);
      for (int k = 0; k < kBody; ++k) grad_start[k] += grad_stage[k];
    }
    for (int k = 0; k < kBody; ++k) grad_x[k] = grad_start[k];
    for (int i = 0; i < n_; ++i) grad_x[kBody + i] = V{};
    if (on_.motor_lag) {
      lag_vjp(start + kBody, grad_s[1], grad_s[2], grad_s[0], grad_command, grad_P);
      for (int i = 0; i < n_; ++i) grad_x[kBody + i] = grad_s[0][i];
    } else {
      for (int i = 0; i < n_; ++i) grad_command[i] += grad_s[0][i] + grad_s[1][i] + grad_s[2][i];
    }
  }

 private:
  /// Through q / |q| at the end of a step, q from the stages.
  void normalize_vjp(const V* start, V* grad_q) const {
    V q[4];
    for (int k = 0; k < 4; ++k) {
      const int j = kQuaternion + k;
      q[k] = start[j] + on_.dt / 6.0 * (k_[0][j] + 2.0 * (k_[1][j] + k_[2][j]) + k_[3][j]);
    }
    const V scale = 1.0 / sqrt<V>(norm2(q));
    V along = V{};
    for (int k = 0; k < 4; ++k) along += grad_q[k] * q[k] * scale * scale;
    for (int k = 0; k < 4; ++k) grad_q[k] = scale * (grad_q[k] - along * q[k]);
  }
};

}  // namespace diffsim::flight
