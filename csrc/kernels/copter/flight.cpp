#include "kernels/copter/flight.h"

#include <vector>

#include "kernels/copter/flight_moving.h"
#include "kernels/huge_pages.h"
#include "kernels/parallel.h"

namespace diffsim {
namespace flight {
namespace {

constexpr int kPartsOfGroup = kGroup / kNativeLanes;

using Record = V[kBody + kMaxRotors];

/// Where the records of a batch go: all of them, or the last of every vehicle.
struct Kept {
  double* data;
  std::int64_t steps;
  int size;
  bool end_alone;

  Kept(double* to, std::int64_t all_steps, int width, const FlightOptions& options)
      : data(to), steps(all_steps), size(width), end_alone(options.end_alone) {}

  std::int64_t rows() const { return end_alone ? 1 : steps + 1; }

  template <class Number>
  void save(const Crew& crew, std::int64_t step, Number number) const {
    if (end_alone && step < steps) return;
    for (int lane = 0; lane < crew.count; ++lane) {
      double* row = data + ((crew.first + lane) * rows() + (end_alone ? 0 : step)) * size;
      for (int k = 0; k < size; ++k) row[k] = number(k)[lane];
    }
  }
};

void fly(Flight& flight, const Crew& crew, std::int64_t steps, const FlightOptions& options,
         const FlightInputs& inputs, double* records, Stop& stop) {
  const int size = flight.record();
  const Kept kept(records, steps, size, options);
  const auto save = [&](std::int64_t step, const V* x) {
    kept.save(crew, step, [x](int k) { return x[k]; });
  };
  Record x;
  load_row(inputs.start, crew, 0, size, x);
  save(0, x);
  for (std::int64_t step = 0; step < steps && !stop.asked(); ++step) {
    flight.command(step, x);
    for (int k = 0; k < options.substeps && !stop.asked(); ++k) flight.step(x);
    save(step + 1, x);
  }
}

/// Rates of the records along a direction in the inputs.
void fly_along(Flying<MovingRows>& flight, const MovingRows& rows, std::int64_t steps,
               const FlightOptions& options, double* rates, Stop& stop) {
  const int size = flight.record();
  const Crew& crew = rows.crew;
  const Kept kept(rates, steps, size, options);
  const auto save = [&](std::int64_t step, const Moving* x) {
    kept.save(crew, step, [x](int k) { return x[k].rate; });
  };
  Moving x[kBody + kMaxRotors];
  rows.load(&FlightInputs::start, 0, size, x);
  save(0, x);
  for (std::int64_t step = 0; step < steps && !stop.asked(); ++step) {
    flight.command(step, x);
    for (int k = 0; k < options.substeps && !stop.asked(); ++k) flight.step(x);
    save(step + 1, x);
  }
}

void fly_back(Flight& flight, const Crew& crew, std::int64_t steps, const FlightOptions& options,
              const double* records, const double* grad_records, const FlightInputGrads& grads,
              Stop& stop) {
  const int size = flight.record(), n = size - kBody;
  const FlightRows kept{records, (steps + 1) * size, size};
  const FlightRows cotangents{grad_records, (options.end_alone ? 1 : steps + 1) * size,
                              options.end_alone ? 0 : size};
  std::vector<V> grad_P(static_cast<std::size_t>(flight.layout().size));
  std::vector<V> grad_K(static_cast<std::size_t>(n * kFeedback));
  std::vector<V> path(static_cast<std::size_t>(options.substeps * size));
  Record grad_x, cotangent, x;
  load_row(cotangents, crew, steps, size, grad_x);
  for (std::int64_t step = steps - 1; step >= 0 && !stop.asked(); --step) {
    load_row(kept, crew, step, size, x);
    flight.command(step, x);
    V* at = path.data();
    for (int k = 0; k < options.substeps && !stop.asked(); ++k, at += size) {
      for (int j = 0; j < size; ++j) at[j] = x[j];
      if (k + 1 < options.substeps) flight.step(x);
    }
    V grad_command[kMaxRotors] = {}, grad_wind[3] = {};
    for (int k = options.substeps - 1; k >= 0 && !stop.asked(); --k) {
      flight.step_vjp(path.data() + k * size, grad_x, grad_command, grad_wind, grad_P.data());
    }
    flight.command_vjp(step, path.data(), grad_command, grad_wind, grad_x, grad_P.data(),
                       grad_K.data(), grads);
    if (options.end_alone) continue;
    load_row(cotangents, crew, step, size, cotangent);
    for (int k = 0; k < size; ++k) grad_x[k] += cotangent[k];
  }
  add_row(grads.start, crew, 0, size, grad_x);
  add_row(grads.parameters, crew, 0, flight.layout().size, grad_P.data());
  if (options.feedback) add_row(grads.gain, crew, 0, n * kFeedback, grad_K.data());
}

/// f(crew) for all vehicles; those of one group one after another, since they may share gradients.
template <class F>
void for_crews(std::int64_t batch, int num_threads, F&& f) {
  const std::int64_t groups = (batch + kGroup - 1) / kGroup;
  ThreadPool pool(groups < num_threads ? static_cast<int>(groups) : num_threads);
  pool.run(groups, [&](std::int64_t group) {
    for (int part = 0; part < kPartsOfGroup; ++part) {
      const std::int64_t first = group * kGroup + part * kNativeLanes;
      if (first >= batch) return;
      const std::int64_t left = batch - first;
      f(Crew{first, group, left < kNativeLanes ? static_cast<int>(left) : kNativeLanes});
    }
  });
}

}  // namespace
}  // namespace flight

void flight_rollout(int num_rotors, std::int64_t batch, std::int64_t steps,
                    const FlightOptions& options, const FlightInputs& inputs, double* records,
                    int num_threads, Stop& stop) {
  const std::int64_t kept = options.end_alone ? 1 : steps + 1;
  on_huge_pages(records,
                sizeof(double) * static_cast<std::size_t>(batch * kept * (kBody + num_rotors)));
  flight::for_crews(batch, num_threads, [&](const flight::Crew& crew) {
    flight::Flight one(num_rotors, options, inputs, crew);
    flight::fly(one, crew, steps, options, inputs, records, stop);
  });
}

void flight_rollout_vjp(int num_rotors, std::int64_t batch, std::int64_t steps,
                        const FlightOptions& options, const FlightInputs& inputs,
                        const double* records, const double* grad_records,
                        const FlightInputGrads& grads, int num_threads, Stop& stop) {
  flight::for_crews(batch, num_threads, [&](const flight::Crew& crew) {
    flight::Flight one(num_rotors, options, inputs, crew);
    flight::fly_back(one, crew, steps, options, records, grad_records, grads, stop);
  });
}

void flight_rollout_tangent(int num_rotors, std::int64_t batch, std::int64_t steps,
                            const FlightOptions& options, const FlightInputs& inputs,
                            const FlightInputs& directions, double* rates, int num_threads,
                            Stop& stop) {
  flight::for_crews(batch, num_threads, [&](const flight::Crew& crew) {
    const flight::MovingRows rows{inputs, directions, crew};
    flight::Flying<flight::MovingRows> one(num_rotors, options, rows);
    flight::fly_along(one, rows, steps, options, rates, stop);
  });
}

}  // namespace diffsim
