// What derivatives of a linearly implicit step need: those of the linearized elastic force.
#pragma once

#include "kernels/soft/elasticity.h"

namespace diffsim {

/// Derivatives of z . (grad E(x) + K(x) d), K = d^2 E/dx^2, overwritten. Elastic and fiber energies
/// only.
/// @param[in]  d, z   (num_nodes, 3)
/// @param[out] force  (num_nodes, 3) d/dx with x + d held fixed: the third derivative of E along z
///                    and d
/// @param[out] out    weights, fiber_stiffness, activation
void linearized_adjoint(const SoftModel& model, const SoftParameters& parameters, const double* x,
                        const double* d, const double* z, double* force,
                        const ParameterAdjoint& out, ElasticityScratch& scratch, ThreadPool& pool);

/// The transpose: d(grad E(x) + K(x) d) along a direction dx of x, with x + d held fixed, and along
/// item k of directions in the parameters (damping's and pressures are not read; that in the tables
/// moves damping at x + d, too).
/// @param[in]  d, dx  (num_nodes, 3)
/// @param[out] force  (num_nodes, 3), overwritten
void linearized_tangent(const SoftModel& model, const SoftParameters& parameters,
                        const DampingFrames& frames, const double* x, const double* d,
                        const double* dx, const ParameterDirections& along, std::int64_t k,
                        double* force, ElasticityScratch& scratch, ThreadPool& pool);

}  // namespace diffsim
