// The parts that solve a step in contact, and the point that they have come to.
#pragma once

#include "kernels/soft/contact/contact_solve.h"
#include "kernels/soft/contact/contact_status.h"
#include "kernels/soft/contact/contact_step.h"

namespace diffsim {

/// The step's objective, its contacts, and the linear solves on what these leave free.
struct ContactProblem {
  ContactProblem(const ConstantSystem& constant_system, const StepInputs& step_inputs,
                 const ContactInputs& contacts, const StepOptions& step_options,
                 const ContactOptions& contact_options, ThreadPool& pool)
      : system(constant_system),
        inputs(step_inputs),
        options(step_options),
        objective(system, inputs, pool, uses_multigrid(system, options.method)),
        space(contacts),
        statuses(space, system.diagonal()),
        solve(objective, system, space, options.method, options.rtol, contact_options.cache_columns,
              pool) {}
  ContactProblem(const ContactProblem&) = delete;
  ContactProblem& operator=(const ContactProblem&) = delete;

  /// Norm of what the statuses leave to solve of a gradient [N].
  double reduced_norm(const Vector& gradient) {
    Vector residual = gradient;
    space.reduce(residual);
    return objective.ops().norm(residual);
  }

  const ConstantSystem& system;
  const StepInputs& inputs;
  const StepOptions& options;
  StepProblem objective;
  ContactSpace space;
  ContactStatuses statuses;
  ContactSolve solve;
};

/// A point with the objective g there.
struct ContactIterate {
  Vector x;         // (num_nodes, 3) [m]
  double value;     // g [J]
  Vector gradient;  // (num_nodes, 3) grad g [N], fixed entries zero

  /// Takes g and its gradient at x.
  void evaluate(StepProblem& objective) { value = objective.value_gradient(x, gradient); }
  /// x = start + length * step, with g there.
  void move(StepProblem& objective, const Vector& start, double length, const Vector& step) {
    x = start;
    objective.ops().add(length, step, x);
    evaluate(objective);
  }
};

}  // namespace diffsim
