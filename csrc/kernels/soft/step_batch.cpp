#include "kernels/soft/batch.h"
#include "kernels/soft/implicit_step.h"
#include "kernels/soft/linear_step.h"
#include "kernels/soft/small_steps.h"

namespace diffsim {
StepInputs batch_item(const StepInputs& in, const SoftModel& model, std::int64_t k) {
  const std::int64_t size = 3 * model.num_nodes;
  StepInputs item = in;
  item.parameters.activation = offset(in.parameters.activation, k, model.fiber.num_elements);
  item.parameters.pressure = offset(in.parameters.pressure, k, model.chambers.num_chambers);
  if (in.per_member) {
    const std::int64_t elements = model.solid.num_elements;
    item.parameters.weights = offset(in.parameters.weights, k, model.weights_size());
    item.parameters.fiber_stiffness =
        offset(in.parameters.fiber_stiffness, k, model.fiber.num_elements);
    item.parameters.damp_mu = offset(in.parameters.damp_mu, k, elements);
    item.parameters.damp_lambda = offset(in.parameters.damp_lambda, k, elements);
    item.inertia = offset(in.inertia, k, model.num_nodes);
  }
  item.y = offset(in.y, k, size);
  item.force = offset(in.force, k, size);
  item.target = offset(in.target, k, size);
  item.guess = offset(in.guess, k, size);
  item.x_frame = offset(in.x_frame, k, size);
  item.x_velocity = offset(in.x_velocity, k, size);
  return item;
}

StepAdjoint batch_item(const StepAdjoint& out, const SoftModel& model, std::int64_t k) {
  const std::int64_t size = 3 * model.num_nodes;
  const std::int64_t elements = model.solid.num_elements, fibers = model.fiber.num_elements;
  StepAdjoint item;
  item.y = offset(out.y, k, size);
  item.force = offset(out.force, k, size);
  item.target = offset(out.target, k, size);
  item.guess = offset(out.guess, k, size);
  item.inertia = offset(out.inertia, k, model.num_nodes);
  item.parameters.weights = offset(out.parameters.weights, k, model.weights_size());
  item.parameters.fiber_stiffness = offset(out.parameters.fiber_stiffness, k, fibers);
  item.parameters.activation = offset(out.parameters.activation, k, fibers);
  item.parameters.damp_mu = offset(out.parameters.damp_mu, k, elements);
  item.parameters.damp_lambda = offset(out.parameters.damp_lambda, k, elements);
  item.parameters.x_frame = offset(out.parameters.x_frame, k, size);
  item.parameters.x_velocity = offset(out.parameters.x_velocity, k, size);
  item.parameters.pressure = offset(out.parameters.pressure, k, model.chambers.num_chambers);
  item.parameters.tables = offset(out.parameters.tables, k, model.tables_size());
  return item;
}

void implicit_step_batch(const ConstantSystem& system, const StepInputs& inputs,
                         const StepOptions& options, std::int64_t batch, double* x,
                         StepStats* stats, int num_threads) {
  const bool by_linear = options.method == StepMethod::kLinearlyImplicit;
  const auto step = steps_are_small(system, options) ? (by_linear ? small_linear_step : small_step)
                                                     : (by_linear ? linear_step : implicit_step);
  for_batch(batch, num_threads, [&](std::int64_t k, ThreadPool& pool) {
    stats[k] = step(system, batch_item(inputs, system.model(), k), options,
                    x + 3 * k * system.model().num_nodes, pool);
  });
}

void implicit_step_adjoint_batch(const ConstantSystem& system, const StepInputs& inputs,
                                 const StepOptions& options, std::int64_t batch, const double* x,
                                 const double* grad_x, const StepAdjoint& out, StepStats* stats,
                                 int num_threads) {
  const std::int64_t size = 3 * system.model().num_nodes;
  const auto adjoint = adjoints_are_small(system, options)               ? small_adjoint
                       : options.method == StepMethod::kLinearlyImplicit ? linear_step_adjoint
                                                                         : implicit_step_adjoint;
  for_batch(batch, num_threads, [&](std::int64_t k, ThreadPool& pool) {
    stats[k] = adjoint(system, batch_item(inputs, system.model(), k), options, x + k * size,
                       grad_x + k * size, batch_item(out, system.model(), k), pool);
  });
}

}  // namespace diffsim
