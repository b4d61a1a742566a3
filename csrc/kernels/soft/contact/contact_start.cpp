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

/// Where inertia and the given forces alone would take the nodes, (num_nodes, 3) [m].
Vector free_flight(const ConstantSystem& system, const StepInputs& inputs) {
  Vector x(inputs.y, inputs.y + 3 * system.model().num_nodes);
  const double* inertia = inputs.inertia ? inputs.inertia : system.inertia();
  for (std::size_t i = 0; i < x.size(); ++i) {
    if (inertia[i / 3] > 0.0) x[i] += inputs.force[i] / inertia[i / 3];
  }
  return x;
}

/// What it takes to move nodes from x onto the constraints of their statuses, each on its own [J].
double lifting_energy(const ContactProblem& p, const Vector& x) {
  Vector onto;
  p.space.correction(x, onto);
  double energy = 0.0;
  for (std::size_t i = 0; i < onto.size(); ++i)
    energy += 0.5 * p.system.diagonal()[i / 3] * onto[i] * onto[i];
  return energy;
}

}  // namespace

ContactIterate contact_start(ContactProblem& problem) {
  ContactProblem& p = problem;
  const auto at = [&](const double* positions) {
    return ContactIterate{with_targets(positions, p.system, p.inputs, p.objective.size()), 0.0, {}};
  };
  const Vector free = free_flight(p.system, p.inputs);
  p.statuses.guess(free);
  ContactIterate guess = at(p.inputs.guess);
  const InertialEnergy energy = inertial_energy(guess.x, p.system, p.inputs);
  if (!(energy.kinetic > 0.0)) {  // statics, or the guess is y
    guess.evaluate(p.objective);
    return guess;
  }
  ContactIterate inertial = at(p.inputs.y);
  inertial.evaluate(p.objective);
  const double lifted = inertial.value + lifting_energy(p, inertial.x);
  // Elastic energy is not negative: the guess has at least this much.
  if (lifted <= energy.kinetic - energy.work) return inertial;
  guess.evaluate(p.objective);
  if (lifted <= guess.value || !std::isfinite(guess.value)) return inertial;
  p.statuses.guess(guess.x);
  if (p.space.any_contact()) return guess;
  // Without contact the guess leads to y.
  p.statuses.guess(free);
  return inertial.value <= guess.value ? inertial : guess;
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
