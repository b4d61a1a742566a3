#include "kernels/soft/contact/contact_start.h"

namespace diffsim {
namespace {

// Smallest length that counts, of half the body's extent.
constexpr double kLengthTolerance = 1e-12;
// Least extent, of the largest coordinate: far from the origin 1e-15 of it counts, five roundings.
constexpr double kLeastExtent = 1e-3;

Vector with_targets(const double* positions, const ConstantSystem& system, const StepInputs& inputs,
                    std::size_t size) {
  Vector x(positions, positions + size);
  for (std::size_t i = 0; i < x.size(); ++i)
    if (system.fixed()[i]) x[i] = inputs.target[i];
  return x;
}

/// Of g at x: 1/2 (x - y)^T diag(inertia) (x - y), and force . (x - y) [J].
struct InertialEnergy {
  double kinetic, work;
};
InertialEnergy inertial_energy(const Vector& x, const ConstantSystem& system,
                               const StepInputs& inputs) {
  const double* inertia = inputs.inertia ? inputs.inertia : system.inertia();
  double kinetic = 0.0, work = 0.0;
  for (std::size_t i = 0; i < x.size(); ++i) {
    if (system.fixed()[i]) continue;
    const double d = x[i] - inputs.y[i];
    kinetic += 0.5 * inertia[i / 3] * d * d;
    work += inputs.force[i] * d;
  }
  return {kinetic, work};
}

}  // namespace

ContactIterate contact_start(StepProblem& objective, const ConstantSystem& system,
                             const StepInputs& inputs) {
  ContactIterate guess{with_targets(inputs.guess, system, inputs, objective.size()), 0.0, {}};
  const InertialEnergy energy = inertial_energy(guess.x, system, inputs);
  if (!(energy.kinetic > 0.0)) {  // statics, or the guess is y
    guess.evaluate(objective);
    return guess;
  }
  ContactIterate inertial{with_targets(inputs.y, system, inputs, objective.size()), 0.0, {}};
  inertial.evaluate(objective);
  // Elastic energy is not negative: the guess has at least this much.
  if (inertial.value <= energy.kinetic - energy.work) return inertial;
  guess.evaluate(objective);
  if (inertial.value <= guess.value || !std::isfinite(guess.value)) return inertial;
  return guess;
}

Vector free_flight(const ConstantSystem& system, const StepInputs& inputs) {
  Vector x(inputs.y, inputs.y + 3 * system.model().num_nodes);
  const double* inertia = inputs.inertia ? inputs.inertia : system.inertia();
  for (std::size_t i = 0; i < x.size(); ++i) {
    if (inertia[i / 3] > 0.0) x[i] += inputs.force[i] / inertia[i / 3];
  }
  return x;
}

double length_tolerance(const Vector& x) {
  double low[3] = {1e300, 1e300, 1e300}, high[3] = {-1e300, -1e300, -1e300}, largest = 0.0;
  for (std::size_t i = 0; i < x.size(); ++i) {
    low[i % 3] = std::min(low[i % 3], x[i]);
    high[i % 3] = std::max(high[i % 3], x[i]);
    largest = std::max(largest, std::abs(x[i]));
  }
  double extent = 0.0;
  for (int a = 0; a < 3; ++a) extent = std::max(extent, 0.5 * (high[a] - low[a]));
  return kLengthTolerance * std::max(extent, kLeastExtent * largest);
}

}  // namespace diffsim
