// Products with a matrix of 3x3 blocks in the model's layout, and its export for factorizing.
#pragma once

#include "kernels/soft/soft_model.h"
#include "kernels/vector_ops.h"

namespace diffsim {

/// y = (K + diag(inertia)) x over nodes; inertia (num_nodes,) acts on all three axes.
/// @param[in] wanted  (num_nodes, 3): of nodes without any y is left as it is; null: all are wanted
void block_multiply(const SoftModel& model, const double* values, const double* inertia,
                    const double* x, double* y, ThreadPool& pool,
                    const std::uint8_t* wanted = nullptr);

/// (num_blocks, 3, 3) row-major blocks of K + diag(inertia), with the rows and columns of fixed
/// unknowns replaced by those of the identity times `fixed_diagonal`.
void export_blocks(const SoftModel& model, const double* values, const double* inertia,
                   const std::uint8_t* fixed, double fixed_diagonal, double* blocks,
                   ThreadPool& pool);

}  // namespace diffsim
