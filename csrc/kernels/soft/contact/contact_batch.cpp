#include "kernels/soft/batch.h"
#include "kernels/soft/contact/contact_step.h"

namespace diffsim {
namespace {

ContactInputs batch_item(const ContactInputs& in, std::int64_t k) {
  const std::int64_t count = in.num_contacts;
  ContactInputs item = in;
  item.normal = offset(in.normal, k, 3 * count);
  item.reference = offset(in.reference, k, 3 * count);
  item.offset = offset(in.offset, k, count);
  item.friction = offset(in.friction, k, count);
  item.force_guess = offset(in.force_guess, k, 3 * count);
  return item;
}

}  // namespace

void contact_step_batch(const ConstantSystem& system, const StepInputs& inputs,
                        const ContactInputs& contacts, const StepOptions& options,
                        const ContactOptions& contact_options, std::int64_t batch, double* x,
                        double* force, std::int64_t* status, StepStats* stats, int num_threads) {
  const std::int64_t size = 3 * system.model().num_nodes, count = contacts.num_contacts;
  for_batch(batch, num_threads, [&](std::int64_t k, ThreadPool& pool) {
    stats[k] = contact_step(system, batch_item(inputs, system.model(), k), batch_item(contacts, k),
                            options, contact_options, x + k * size, force + 3 * k * count,
                            status + k * count, pool);
  });
}

void contact_step_adjoint_batch(const ConstantSystem& system, const StepInputs& inputs,
                                const ContactInputs& contacts, const StepOptions& options,
                                const ContactOptions& contact_options, std::int64_t batch,
                                const double* x, const std::int64_t* status, const double* grad_x,
                                const double* grad_force, const StepAdjoint& out,
                                const ContactAdjoint& contact_out, StepStats* stats,
                                int num_threads) {
  const std::int64_t size = 3 * system.model().num_nodes, count = contacts.num_contacts;
  for_batch(batch, num_threads, [&](std::int64_t k, ThreadPool& pool) {
    const ContactAdjoint item{
        offset(contact_out.normal, k, 3 * count), offset(contact_out.reference, k, 3 * count),
        offset(contact_out.offset, k, count), offset(contact_out.friction, k, count)};
    stats[k] = contact_step_adjoint(
        system, batch_item(inputs, system.model(), k), batch_item(contacts, k), options,
        contact_options, x + k * size, status + k * count, grad_x + k * size,
        grad_force + 3 * k * count, batch_item(out, system.model(), k), item, pool);
  });
}

}  // namespace diffsim
