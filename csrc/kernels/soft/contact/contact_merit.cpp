#include "kernels/soft/contact/contact_merit.h"

namespace diffsim {

Vector friction_limits(StepProblem& objective, const ContactSpace& space, const Vector& gradient,
                       const Vector& step) {
  Vector limits(space.size(), 0.0), change;
  objective.multiply(step, change);
  for (std::size_t k = 0; k < space.size(); ++k)
    if (space.status[k] == ContactStatus::kSlip)
      limits[k] = space.inputs().friction[k] *
                  std::max(0.0, space.normal_part(k, gradient) + space.normal_part(k, change));
  return limits;
}

double merit(const ContactSpace& space, const Vector& limits, const Vector& x, double value) {
  double u[3];
  for (std::size_t k = 0; k < space.size(); ++k)
    if (limits[k] > 0.0) value += limits[k] * space.slip(k, x, u);
  return value;
}

double dissipation_rounding(const ContactSpace& space, const Vector& limits, const Vector& x) {
  double total = 0.0;
  for (std::size_t k = 0; k < space.size(); ++k) total += limits[k] * space.rounding(k, x);
  return total;
}

double merit_slope(StepProblem& objective, const ContactSpace& space, const Vector& limits,
                   const Vector& gradient, const Vector& q) {
  double slope = objective.ops().dot(gradient, q);
  for (std::size_t k = 0; k < space.size(); ++k)
    for (std::size_t i = 0; limits[k] > 0.0 && i < 3; ++i)
      slope += limits[k] * space.direction[3 * k + i] * q[3 * space.node(k) + i];
  return slope;
}

}  // namespace diffsim
