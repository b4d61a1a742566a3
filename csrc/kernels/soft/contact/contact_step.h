// One implicit step of a soft body in contact, and its adjoint.
//
// Forward: grad g(x) = r (thesis eq. 4.25) where r vanishes but at nodes in contact, and each
// contact separates, sticks or slips (contact_space.h). Semismooth Newton: each iteration takes the
// statuses from the trial force r - rho (slip, gap) (Alart and Curnier 1991; Hintermueller, Ito and
// Kunisch 2002), and solves for the free unknowns. The statuses found are exact; no penalty, no
// smoothing.
#pragma once

#include "kernels/soft/contact/contact_space.h"
#include "kernels/soft/implicit_step.h"

namespace diffsim {

struct ContactOptions {
  bool cache_columns = true;  // see ContactPreconditioner
};

/// @param[out] x       (num_nodes, 3) [m]
/// @param[out] force   (num_contacts, 3) contact force on each node [N]
/// @param[out] status  (num_contacts,) ContactStatus
StepStats contact_step(const ConstantSystem& system, const StepInputs& inputs,
                       const ContactInputs& contacts, const StepOptions& options,
                       const ContactOptions& contact_options, double* x, double* force,
                       std::int64_t* status, ThreadPool& pool);

/// Gradients of a loss to the contacts; none to the guess.
struct ContactAdjoint {
  double* normal = nullptr;     // (num_contacts, 3)
  double* reference = nullptr;  // (num_contacts, 3)
  double* offset = nullptr;     // (num_contacts,)
  double* friction = nullptr;   // (num_contacts,)
};

/// The statuses are held: where one is about to change, the gradient is that of its side.
/// @param[in] grad_x, grad_force  (num_nodes, 3), (num_contacts, 3)
StepStats contact_step_adjoint(const ConstantSystem& system, const StepInputs& inputs,
                               const ContactInputs& contacts, const StepOptions& options,
                               const ContactOptions& contact_options, const double* x,
                               const std::int64_t* status, const double* grad_x,
                               const double* grad_force, const StepAdjoint& out,
                               const ContactAdjoint& contact_out, ThreadPool& pool);

/// A direction in the contacts; null where none moves.
struct ContactRates {
  const double* normal = nullptr;     // (num_contacts, 3)
  const double* reference = nullptr;  // (num_contacts, 3)
  const double* offset = nullptr;     // (num_contacts,)
  const double* friction = nullptr;   // (num_contacts,)
};

/// The answer's derivative along one direction (`directions.count` is 1), the transpose of
/// contact_step_adjoint: statuses are held.
/// @param[out] dx      (num_nodes, 3)
/// @param[out] dforce  (num_contacts, 3)
StepStats contact_step_tangent(const ConstantSystem& system, const StepInputs& inputs,
                               const ContactInputs& contacts, const StepOptions& options,
                               const ContactOptions& contact_options, const double* x,
                               const std::int64_t* status, const StepDirections& direction,
                               const ContactRates& contact_direction, double* dx, double* dforce,
                               ThreadPool& pool);

/// Batches: nodes are shared by the items, all else has a leading batch axis.
void contact_step_batch(const ConstantSystem& system, const StepInputs& inputs,
                        const ContactInputs& contacts, const StepOptions& options,
                        const ContactOptions& contact_options, std::int64_t batch, double* x,
                        double* force, std::int64_t* status, StepStats* stats, int num_threads);
void contact_step_adjoint_batch(const ConstantSystem& system, const StepInputs& inputs,
                                const ContactInputs& contacts, const StepOptions& options,
                                const ContactOptions& contact_options, std::int64_t batch,
                                const double* x, const std::int64_t* status, const double* grad_x,
                                const double* grad_force, const StepAdjoint& out,
                                const ContactAdjoint& contact_out, StepStats* stats,
                                int num_threads);

}  // namespace diffsim
