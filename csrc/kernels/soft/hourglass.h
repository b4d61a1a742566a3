// Hourglass strains of a hexahedron whose solid is evaluated at its mean deformation gradient F.
//
// The trilinear map is x(xi) = c + sum_r a_r xi_r + h_01 xi_0 xi_1 + ... + h_012 xi_0 xi_1 xi_2 on
// [-1, 1]^3. F sees the a_r alone. The amplitudes h, made orthogonal to linear fields (gamma of
// Flanagan, Belytschko 1981), enter by the linear part of Green's strain,
//   E_rs(xi) = ... + xi_d (h_rd . F A_s + h_sd . F A_r)/2,   A_r = dX/dxi_r at the center,
// which is zero under rigid motions and of second order about any affine one (patch test). For each
// direction d only the strains in its mid-surface r, s != d are kept, with the moduli of plane
// stress: what bends is as stiff as a plate or a beam, whatever Poisson's ratio. The strains left
// out, shear and thickness change that vary along the element, are what locks, and what enhanced
// assumed strains (Simo, Rifai 1990) would set free. With strains in orthonormal axes of the
// mid-surface and their weight V/3 taken into the rows (diffsim/soft/elements.py),
//   energy = w[0]/2 |s|^2 + w[1]/2 sum_d (s_d0 + s_d1)^2,   w = (2 mu, 2 mu lambda/(lambda + 2
//   mu)), s_k = sum of h_m . F row_r over the rows r of strain k: bilinear in (F, h).
#pragma once

#include "kernels/soft/elasticity.h"
#include "kernels/soft/element_matrix.h"

namespace diffsim::hourglass {

// Each adds what hourglass strains have to give, and does nothing where there are none; `vectors`
// is a vectors buffer that other parts of the energy have filled.

void fill_frames(const SoftModel& model, const double* x_frame, const double* x_velocity,
                 DampingFrames& frames, ThreadPool& pool);

/// Returns the energy [J].
double add_gradient(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                    const double* x, ElasticityScratch& scratch, ThreadPool& pool);

/// Matrices of a group, those of the stress included; see element_matrix.h.
/// @param[in] stress  tangent of the solid and its damping at the mean deformation gradient
void element_matrix(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                    const double* x, bool clamp, std::int64_t g, const GroupTangent& stress,
                    double* out);

/// Adds the second derivative's product with z, stress included.
void add_product(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                 const double* x, const double* z, double* vectors, ThreadPool& pool);

void add_parameter_adjoint(const SoftModel& model, const double* x, const double* z,
                           double* weights, ThreadPool& pool);
void add_damping_adjoint(const SoftModel& model, const SoftParameters& p,
                         const DampingFrames& frames, const double* x, const double* z,
                         bool frame_pass, const ParameterAdjoint& out, double* vectors,
                         ThreadPool& pool);
void add_energy_slopes(const SoftModel& model, const double* x, double* weights, ThreadPool& pool);
void add_parameter_tangent(const SoftModel& model, const SoftParameters& p,
                           const DampingFrames& frames, const double* x, std::int64_t k,
                           const ParameterDirections& d, double* vectors, ThreadPool& pool);

void add_linearized_adjoint(const SoftModel& model, const SoftParameters& p, const double* x,
                            const double* d, const double* z, double* weights, double* vectors,
                            ThreadPool& pool);
void add_linearized_tangent(const SoftModel& model, const SoftParameters& p, const double* x,
                            const double* d, const double* dx, const ParameterDirections& along,
                            std::int64_t k, double* vectors, ThreadPool& pool);

// Of shape_derivatives.h; z null: derivatives of E.
void add_shape_adjoint(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                       const double* x, const double* d, const double* z, double* tables,
                       ThreadPool& pool);
void add_shape_tangent(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                       const double* x, const double* d, const double* tables, double* vectors,
                       ThreadPool& pool);

/// Stiffness of each lane's modes over the scalar nodes, for unit moduli [m].
/// @param[out] out  (8, 8): nodes a and b
void scalar_matrix(const HourglassShape& shape, Lane out[8][8]);

}  // namespace diffsim::hourglass
