// Volume, interface area and normal of all cells of a grid, and the flux through a grid plane.
#pragma once

#include "kernels/parallel.h"
#include "kernels/stokes/stokes_grid.h"

namespace diffsim {

/// @param[in]  phi    (num_nodes,) level set, > 0 in the fluid
/// @param[out] volume (num_cells,) fluid volume [m^D]
/// @param[out] area   (num_cells,) interface area [m^(D-1)]
/// @param[out] normal (num_cells, D) out of the fluid; zero in cells without interface
void cut_cells(const GridShape& shape, const double* phi, double* volume, double* area,
               double* normal, ThreadPool& pool);

/// @param[out] grad_phi (num_nodes,) overwritten
void cut_cells_vjp(const GridShape& shape, const double* phi, const double* grad_volume,
                   const double* grad_area, const double* grad_normal, double* grad_phi,
                   ThreadPool& pool);

/// Rates of volume, area and normal along d_phi, (num_nodes,); overwritten.
void cut_cells_jvp(const GridShape& shape, const double* phi, const double* d_phi, double* d_volume,
                   double* d_area, double* d_normal, ThreadPool& pool);

/// Volume flow through the fluid part of the grid plane `index` normal to `axis`, positive along
/// it; within the box the mean of what the cells on its two sides take as fluid. In 2D both
/// take the same, and the flow's equations conserve this flux.
/// @param[in]  v    (cases, num_nodes, D) [m/s]
/// @param[out] flux (cases,) [m^D/s]
void plane_flux(const GridShape& shape, const double* phi, const double* v, std::int64_t cases,
                int axis, std::int64_t index, double* flux);

/// @param[out] grad_phi (num_nodes,), grad_v (cases, num_nodes, D); overwritten
void plane_flux_vjp(const GridShape& shape, const double* phi, const double* v, std::int64_t cases,
                    int axis, std::int64_t index, const double* grad_flux, double* grad_phi,
                    double* grad_v);

/// Rate of the flux along d_phi (num_nodes,) and d_v (cases, num_nodes, D); overwritten.
void plane_flux_jvp(const GridShape& shape, const double* phi, const double* v, const double* d_phi,
                    const double* d_v, std::int64_t cases, int axis, std::int64_t index,
                    double* d_flux);

}  // namespace diffsim
