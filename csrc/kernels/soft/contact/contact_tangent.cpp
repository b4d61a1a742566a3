#include "kernels/soft/contact/contact_answer.h"

namespace diffsim {
namespace {

/// What a direction in the contacts does at one node.
struct Push {
  double moved[3] = {0, 0, 0};  // displacement that the constraint prescribes [m]
  double load[3] = {0, 0, 0};   // right-hand side of Coulomb's law [N]
};

double component(const double* values, std::size_t i) { return values ? values[i] : 0.0; }

/// The transpose of contact_gradients in contact_adjoint.cpp, term by term.
Push push_of(const ContactSpace& space, const ContactRates& d, std::size_t k, const Vector& x,
             const Vector& r) {
  Push out;
  if (space.status[k] == ContactStatus::kSeparate) return out;
  const std::size_t at = 3 * space.node(k);
  const double* n = space.normal(k);
  const double* t = space.direction.data() + 3 * k;
  const double offset = space.inputs().offset[k], friction = space.inputs().friction[k];
  const double d_offset = component(d.offset, k), d_friction = component(d.friction, k);
  double carried[3];  // of the point reference + offset n
  double opened = d_offset, turned = 0.0;
  for (std::size_t i = 0; i < 3; ++i) {
    const double dn = component(d.normal, 3 * k + i), dref = component(d.reference, 3 * k + i);
    carried[i] = dref + offset * dn;
    opened += n[i] * dref - dn * (x[at + i] - space.inputs().reference[3 * k + i]);
    turned += r[at + i] * dn;
  }
  if (space.status[k] == ContactStatus::kStick) {
    for (std::size_t i = 0; i < 3; ++i) out.moved[i] = carried[i] + d_offset * n[i];
    return out;
  }
  double along = 0.0, forward = 0.0;
  for (std::size_t i = 0; i < 3; ++i) {
    along += n[i] * carried[i];
    forward += t[i] * carried[i];
  }
  const double pressing = space.normal_part(k, r);
  const double stiffness = space.on_rail(k) ? 0.0 : space.slip_stiffness[k];
  for (std::size_t i = 0; i < 3; ++i) {
    const double dn = component(d.normal, 3 * k + i);
    const double across = carried[i] - along * n[i] - forward * t[i];
    out.moved[i] = opened * n[i] + (space.on_rail(k) ? across : 0.0);
    out.load[i] =
        stiffness * across + pressing * dn - t[i] * (friction * turned + pressing * d_friction);
  }
  return out;
}

}  // namespace

StepStats contact_step_tangent(const ConstantSystem& system, const StepInputs& inputs,
                               const ContactInputs& contacts, const StepOptions& options,
                               const ContactOptions& contact_options, const double* x_in,
                               const std::int64_t* status, const StepDirections& direction,
                               const ContactRates& contact_direction, double* dx_out,
                               double* dforce, ThreadPool& pool) {
  ContactAnswer answer(system, inputs, contacts, x_in, status,
                       uses_multigrid(system, options.method), pool);
  StepProblem& problem = answer.problem;
  const ContactSpace& space = answer.space;
  const std::size_t size = problem.size();

  // What the constraints and the targets prescribe moves first, the rest follows.
  Vector dx(size, 0.0), load(size, 0.0), b(size), product;
  for (std::size_t i = 0; i < size; ++i)
    if (system.fixed()[i] && direction.target) dx[i] = direction.target[i];
  for (std::size_t k = 0; k < space.size(); ++k) {
    const Push push = push_of(space, contact_direction, k, answer.x, answer.r);
    for (std::size_t i = 0; i < 3; ++i) {
      dx[3 * space.node(k) + i] += push.moved[i];
      load[3 * space.node(k) + i] = push.load[i];
    }
  }
  problem.load_tangents(answer.x, direction, b.data());
  Vector rhs = b, q;
  problem.multiply_all(dx, product);
  problem.ops().add(-1.0, product, rhs);
  problem.zero_fixed(rhs);
  space.reduce(rhs);
  space.project(load);
  problem.ops().add(1.0, load, rhs);

  const StepStats stats = answer.solve(LinearSide::kForward, options, contact_options, rhs, q);
  problem.ops().add(1.0, q, dx);
  problem.multiply_all(dx, product);
  std::copy(dx.begin(), dx.end(), dx_out);
  for (std::size_t k = 0; k < space.size(); ++k) {
    const bool touches = static_cast<ContactStatus>(status[k]) != ContactStatus::kSeparate;
    for (std::size_t i = 0; i < 3; ++i) {
      const std::size_t u = 3 * space.node(k) + i;
      dforce[3 * k + i] = touches ? product[u] - b[u] : 0.0;
    }
  }
  return stats;
}

}  // namespace diffsim
