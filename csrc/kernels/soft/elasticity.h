// Elastic energy of a soft body with muscles and damping: gradient, tangent matrix, and the adjoint
// of the gradient with respect to its parameters.
#pragma once

#include <vector>

#include "kernels/linalg/aligned_buffer.h"
#include "kernels/parallel.h"
#include "kernels/soft/soft_model.h"

namespace diffsim {

/// Parameters of the energy; all arrays belong to the caller.
struct SoftParameters {
  const double* weights = nullptr;          // (num_weights, num_elements) [Pa], see material.h
  const double* fiber_stiffness = nullptr;  // (num_fibers,) [Pa]
  const double* activation = nullptr;       // (num_fibers,) target stretch [-]
  const double* damp_mu = nullptr;          // (num_elements,) beta kappa 2 mu [Pa]; null: undamped
  const double* damp_lambda = nullptr;      // (num_elements,) beta kappa lambda [Pa]
  const double* pressure = nullptr;         // (num_chambers,) gauge pressure [Pa], see pressure.h
};

/// Deformation gradients of the frames that damping refers to (see damping.h), one entry a group.
struct DampingFrame {
  Lane Fn[9], Fv[9];
};
/// Hourglass amplitudes of the same frames, see hourglass.h.
struct HourglassFrame {
  Lane hn[3 * kHourglassModes], hv[3 * kHourglassModes];
};
struct DampingFrames {
  const double* x_frame = nullptr;  // (num_nodes, 3) what they are made of [m]
  const double* x_velocity = nullptr;
  std::vector<DampingFrame> solid;
  std::vector<HourglassFrame> hourglass;  // empty where there are no hourglass strains
};

/// Reusable memory of one evaluation at a time, of one model.
struct ElasticityScratch {
  std::vector<double> vectors, partial, blocks;
  /// Whether the solid's samples (material.h) are kept, so that another derivative at the same
  /// positions (compared bit by bit) need not make them again. Not those of large bodies, see
  /// element_stage.h.
  bool keep_samples = false;
  /// Whether a gradient leaves them as they are, where the material knows its stresses without.
  bool stresses_alone = false;
  std::vector<double> kept_at;  // positions that `samples` belongs to
  AlignedBuffer<double> samples;
};

/// @param[in] x_frame     (num_nodes, 3) predicted positions, F_n [m]
/// @param[in] x_velocity  (num_nodes, 3) positions that velocity is measured from, F_v [m]
DampingFrames damping_frames(const SoftModel& model, const double* x_frame,
                             const double* x_velocity, ThreadPool& pool);

/// Energy E + D [J] and its gradient [N], overwritten.
double energy_gradient(const SoftModel& model, const SoftParameters& parameters,
                       const DampingFrames& frames, const double* x, double* gradient,
                       ElasticityScratch& scratch, ThreadPool& pool);

/// d^2(E + D)/dx^2 z [N], overwritten, without a matrix: for a single product.
void tangent_product(const SoftModel& model, const SoftParameters& parameters,
                     const DampingFrames& frames, const double* x, const double* z, double* out,
                     ElasticityScratch& scratch, ThreadPool& pool);

/// d^2(E + D)/dx^2 [N/m] in the model's layout, overwritten.
/// @param[in] clamp  drop negative eigenvalues of each sample's tangent
void tangent(const SoftModel& model, const SoftParameters& parameters, const DampingFrames& frames,
             const double* x, bool clamp, double* values, ElasticityScratch& scratch,
             ThreadPool& pool);

/// z . d(gradient)/dp for every parameter p of the energy, overwritten.
struct ParameterAdjoint {
  double* weights = nullptr;          // this and the next may be null in parameter_adjoint
  double* fiber_stiffness = nullptr;  // (num_fibers,)
  double* activation = nullptr;
  double* damp_mu = nullptr;  // this and the next three by damping_adjoint
  double* damp_lambda = nullptr;
  double* x_frame = nullptr;     // (num_nodes, 3)
  double* x_velocity = nullptr;  // (num_nodes, 3)
  double* pressure = nullptr;    // (num_chambers,), by pressure_adjoint
  double* tables = nullptr;      // SoftModel::tables_size(), by shape_adjoint; may be null
};
void parameter_adjoint(const SoftModel& model, const SoftParameters& parameters, const double* x,
                       const double* z, const ParameterAdjoint& out, ElasticityScratch& scratch,
                       ThreadPool& pool);
/// Its part of damping, where there is any.
void damping_adjoint(const SoftModel& model, const SoftParameters& parameters,
                     const DampingFrames& frames, const double* x, const double* z,
                     const ParameterAdjoint& out, ElasticityScratch& scratch, ThreadPool& pool);

/// dE/dp for the weights, stiffnesses and activations of E, without damping, overwritten.
void energy_slopes(const SoftModel& model, const SoftParameters& parameters, const double* x,
                   const ParameterAdjoint& out, ElasticityScratch& scratch, ThreadPool& pool);

/// Directions in the parameters of the energy, (count, ...) each; null where none moves. Those of
/// damping need a damped body.
struct ParameterDirections {
  const double* weights = nullptr;          // (count, num_weights, num_elements)
  const double* fiber_stiffness = nullptr;  // (count, num_fibers)
  const double* activation = nullptr;       // (count, num_fibers)
  const double* damp_mu = nullptr;          // (count, num_elements)
  const double* damp_lambda = nullptr;      // (count, num_elements)
  const double* x_frame = nullptr;          // (count, num_nodes, 3)
  const double* x_velocity = nullptr;       // (count, num_nodes, 3)
  const double* pressure = nullptr;         // (count, num_chambers), by the caller
  const double* tables = nullptr;           // (count, SoftModel::tables_size())
};

/// d(gradient)/dp along each direction but the pressure's [N], overwritten: the transpose of
/// parameter_adjoint.
/// @param[out] out  (count, num_nodes, 3)
void parameter_tangent(const SoftModel& model, const SoftParameters& parameters,
                       const DampingFrames& frames, const double* x, std::int64_t count,
                       const ParameterDirections& directions, double* out,
                       ElasticityScratch& scratch, ThreadPool& pool);

/// Elements that have a sample with det F <= 0 (or NaN) at x.
std::int64_t count_inverted(const SoftModel& model, const double* x);

}  // namespace diffsim
