// What the adjoint of a linearly implicit step needs: derivatives of the linearized elastic force.
#pragma once

#include "kernels/soft/elasticity.h"

namespace diffsim {

/// Derivatives of z . (grad E(x) + K(x) d), K = d^2 E/dx^2, overwritten. Elastic and fiber energies
/// only.
/// @param[in]  d, z   (num_nodes, 3)
/// @param[out] force  (num_nodes, 3) d/dx with x + d held fixed: the third derivative of E along z
///                    and d
/// @param[out] out    w_mu, w_vol, fiber_stiffness, activation
void linearized_adjoint(const SoftModel& model, const SoftParameters& parameters, const double* x,
                        const double* d, const double* z, double* force,
                        const ParameterAdjoint& out, ElasticityScratch& scratch, ThreadPool& pool);

}  // namespace diffsim
