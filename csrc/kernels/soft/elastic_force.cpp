#include "kernels/soft/elastic_force.h"

#include "kernels/soft/batch.h"
#include "kernels/soft/block_matrix.h"
#include "kernels/soft/pressure.h"
#include "kernels/soft/shape_derivatives.h"

namespace diffsim {
namespace {

DampingFrames frames_of(const SoftModel& model, const StepInputs& in, ThreadPool& pool) {
  if (!in.parameters.damp_mu) return {};
  return damping_frames(model, in.x_frame, in.x_velocity, pool);
}

/// Derivative of the gradient along z [N], overwritten.
void product_along(const SoftModel& model, const StepInputs& in, const DampingFrames& frames,
                   const double* x, const double* z, double* out, ElasticityScratch& scratch,
                   ThreadPool& pool) {
  tangent_product(model, in.parameters, frames, x, z, out, scratch, pool);
  if (model.chambers.num_chambers == 0) return;
  Vector values(static_cast<std::size_t>(model.values_size()), 0.0);
  const std::size_t size = static_cast<std::size_t>(3 * model.num_nodes);
  const Vector no_inertia(size / 3, 0.0);
  Vector pushed(size);
  add_pressure_tangent(model, in.parameters.pressure, x, values.data(), pool);
  block_multiply(model, values.data(), no_inertia.data(), z, pushed.data(), pool);
  for (std::size_t i = 0; i < size; ++i) out[i] += pushed[i];
}

}  // namespace

void elastic_gradient(const SoftModel& model, const StepInputs& inputs, std::int64_t batch,
                      const double* x, double* gradient, double* energy, int num_threads) {
  const std::int64_t size = 3 * model.num_nodes;
  for_batch(batch, num_threads, [&](std::int64_t k, ThreadPool& pool) {
    const StepInputs in = batch_item(inputs, model, k);
    ElasticityScratch scratch;
    double* out = gradient + k * size;
    energy[k] = energy_gradient(model, in.parameters, frames_of(model, in, pool), x + k * size, out,
                                scratch, pool);
    energy[k] += add_pressure_gradient(model, in.parameters.pressure, x + k * size, out, pool);
  });
}

void elastic_gradient_adjoint(const SoftModel& model, const StepInputs& in, const double* x,
                              const double* z, double* grad_x, const ParameterAdjoint& out,
                              int num_threads) {
  ThreadPool pool(num_threads);
  ElasticityScratch scratch;
  scratch.keep_samples = true;
  const DampingFrames frames = frames_of(model, in, pool);
  product_along(model, in, frames, x, z, grad_x, scratch, pool);
  parameter_adjoint(model, in.parameters, x, z, out, scratch, pool);
  damping_adjoint(model, in.parameters, frames, x, z, out, scratch, pool);
  shape_adjoint(model, in.parameters, frames, x, nullptr, z, out, pool);
  pressure_adjoint(model, x, z, out.pressure, pool);
}

void elastic_gradient_tangent(const SoftModel& model, const StepInputs& in, const double* x,
                              const double* dx, const ParameterDirections& directions, double* out,
                              int num_threads) {
  ThreadPool pool(num_threads);
  ElasticityScratch scratch;
  const DampingFrames frames = frames_of(model, in, pool);
  const std::size_t size = static_cast<std::size_t>(3 * model.num_nodes);
  parameter_tangent(model, in.parameters, frames, x, 1, directions, out, scratch, pool);
  if (directions.pressure) add_pressure_gradient(model, directions.pressure, x, out, pool);
  if (!dx) return;
  Vector moved(size);
  product_along(model, in, frames, x, dx, moved.data(), scratch, pool);
  for (std::size_t i = 0; i < size; ++i) out[i] += moved[i];
}

void elastic_energy_slopes(const SoftModel& model, const StepInputs& in, const double* x,
                           const ParameterAdjoint& out, int num_threads) {
  ThreadPool pool(num_threads);
  ElasticityScratch scratch;
  energy_slopes(model, in.parameters, x, out, scratch, pool);
  pressure_adjoint(model, x, x, out.pressure, pool);
  if (!out.pressure) return;
  // a volume is homogeneous of degree three: x . dV/dx = 3 V
  for (std::int64_t c = 0; c < model.chambers.num_chambers; ++c) out.pressure[c] /= 3.0;
}

}  // namespace diffsim
