#include "kernels/soft/contact/contact_answer.h"

namespace diffsim {
namespace {

/// With e = dL/dx - H z, sticking: x = reference + offset n and e is the multiplier of all three;
/// slipping: n . e is that of the gap, p that of Coulomb's law (contact_space.h).
void contact_gradients(const ContactSpace& space, const Vector& x, const Vector& r, const Vector& e,
                       const Vector& p, const ContactAdjoint& out) {
  for (std::size_t k = 0; k < space.size(); ++k) {
    double* normal = out.normal + 3 * k;
    double* reference = out.reference + 3 * k;
    std::fill_n(normal, 3, 0.0);
    std::fill_n(reference, 3, 0.0);
    out.offset[k] = out.friction[k] = 0.0;
    if (space.status[k] == ContactStatus::kSeparate) continue;
    const std::size_t at = 3 * space.node(k);
    const double* n = space.normal(k);
    const double* t = space.direction.data() + 3 * k;
    const double offset = space.inputs().offset[k], friction = space.inputs().friction[k];
    const double along = space.normal_part(k, e);
    out.offset[k] = along;
    if (space.status[k] == ContactStatus::kStick) {
      for (std::size_t i = 0; i < 3; ++i) {
        reference[i] = e[at + i];
        normal[i] = offset * e[at + i];
      }
      continue;
    }
    double sliding = 0.0, forward = 0.0;  // t . p, t . e
    for (std::size_t i = 0; i < 3; ++i) {
      sliding += t[i] * p[at + i];
      forward += t[i] * e[at + i];
    }
    const double pressing = space.normal_part(k, r);
    out.friction[k] = -sliding * pressing;
    for (std::size_t i = 0; i < 3; ++i) {
      // D p, which on a rail is what holds the node on it
      const double turn = space.on_rail(k) ? e[at + i] - along * n[i] - forward * t[i]
                                           : space.slip_stiffness[k] * (p[at + i] - sliding * t[i]);
      reference[i] = along * n[i] + turn;
      normal[i] = -along * (x[at + i] - space.inputs().reference[3 * k + i]) +
                  pressing * p[at + i] - friction * sliding * r[at + i] + offset * turn;
    }
  }
}

}  // namespace

StepStats contact_step_adjoint(const ConstantSystem& system, const StepInputs& inputs,
                               const ContactInputs& contacts, const StepOptions& options,
                               const ContactOptions& contact_options, const double* x_in,
                               const std::int64_t* status, const double* grad_x,
                               const double* grad_force, const StepAdjoint& out,
                               const ContactAdjoint& contact_out, ThreadPool& pool) {
  ContactAnswer answer(system, inputs, contacts, x_in, status,
                       uses_multigrid(system, options.method), pool);
  StepProblem& problem = answer.problem;
  const ContactSpace& space = answer.space;

  // The forces r = grad g at nodes in contact are outputs as well: c is their cotangent.
  Vector c(problem.size(), 0.0), e(grad_x, grad_x + problem.size()), product;
  bool has_force_gradient = false;
  for (std::size_t k = 0; k < space.size(); ++k) {
    if (static_cast<ContactStatus>(status[k]) == ContactStatus::kSeparate) continue;
    for (std::size_t i = 0; i < 3; ++i) {
      c[3 * space.node(k) + i] = grad_force[3 * k + i];
      has_force_gradient = has_force_gradient || grad_force[3 * k + i] != 0.0;
    }
  }
  if (has_force_gradient) {
    problem.multiply_all(c, product);
    problem.ops().add(1.0, product, e);
  }
  Vector b = e, p;
  problem.zero_fixed(b);
  space.project(b);
  const StepStats stats = answer.solve(LinearSide::kTransposed, options, contact_options, b, p);

  Vector z = p;
  space.expand(z);
  problem.multiply_all(z, product);
  problem.ops().add(-1.0, product, e);
  contact_gradients(space, answer.x, answer.r, e, p, contact_out);
  problem.ops().add(-1.0, c, z);
  problem.input_gradients(answer.x, z, e, out);
  return stats;
}

}  // namespace diffsim
