// A step that was taken, linearized at its answer: what its adjoint and its tangent have in common.
#pragma once

#include "kernels/soft/contact/contact_solve.h"
#include "kernels/soft/contact/contact_step.h"

namespace diffsim {

class ContactAnswer {
 public:
  /// @param[in] x       (num_nodes, 3) the answer [m]
  /// @param[in] status  (num_contacts,) its statuses, which are held
  ContactAnswer(const ConstantSystem& system, const StepInputs& inputs,
                const ContactInputs& contacts, const double* x, const std::int64_t* status,
                bool by_multigrid, ThreadPool& pool);
  ContactAnswer(const ContactAnswer&) = delete;
  ContactAnswer& operator=(const ContactAnswer&) = delete;

  /// Solves with the tangent on what contact leaves free, to options.rtol of rhs.
  StepStats solve(LinearSide side, const StepOptions& options,
                  const ContactOptions& contact_options, const Vector& rhs, Vector& out);

 private:
  const ConstantSystem& system_;
  ThreadPool& pool_;

 public:
  StepProblem problem;  // H assembled at x
  const Vector x;       // (num_nodes, 3) [m]
  Vector r;             // (num_nodes, 3) grad g at x [N]
  ContactSpace space;
};

}  // namespace diffsim
