// Stokes flow: cut cells, prepared systems, solve, tangent and adjoint.
#include <nanobind/stl/shared_ptr.h>

#include "bindings/bindings.h"
#include "kernels/stokes/closest_curve.h"
#include "kernels/stokes/closest_surface.h"
#include "kernels/stokes/cut_cells.h"
#include "kernels/stokes/flow_system.h"

namespace diffsim {
namespace {

using namespace nb::literals;

/// Filled by name; zero addresses mean absent.
struct StokesArrays {
  std::int64_t num_cases = 1;
  double viscosity = 1.0;
  Address prescribed = 0, wall_velocity = 0, body_force = 0, traction = 0;
  std::int64_t wall_velocity_stride = 0, body_force_stride = 0, traction_stride = 0;

  FlowInputs inputs() const {
    return {num_cases,
            viscosity,
            in(prescribed),
            {in(wall_velocity), in(body_force), in(traction)},
            wall_velocity_stride,
            body_force_stride,
            traction_stride};
  }
};

GridShape make_shape(nb::sequence cells, nb::sequence spacing) {
  GridShape shape;
  shape.dim = static_cast<int>(nb::len(cells));
  for (int a = 0; a < shape.dim; ++a) {
    shape.cells[a] = nb::cast<std::int64_t>(cells[a]);
    shape.spacing[a] = nb::cast<double>(spacing[a]);
  }
  return shape;
}

SplineSurface make_spline_surface(Address homogeneous, nb::sequence axes) {
  SplineSurface surface;
  surface.homogeneous = in(homogeneous);
  for (int k = 0; k < 2; ++k) surface.axes[k] = nb::cast<SplineAxis>(axes[k]);
  return surface;
}

/// Closest points of curves and surfaces.
void bind_closest(nb::module_& m) {
  m.attr("MAX_SPLINE_DEGREE") = kMaxSplineDegree;
  nb::class_<SplineAxis>(m, "SplineAxis");
  nb::class_<SplineSurface>(m, "SplineSurface");
  m.def(
      "make_spline_axis",
      [](std::int64_t num, int degree, std::int64_t num_spans, Address breaks, Address coefficients,
         Address first, std::int64_t num_kinks, Address kinks, double low, double high) {
        return SplineAxis{
            num,       degree,    num_spans, in(breaks), in(coefficients), in_index(first),
            num_kinks, in(kinks), low,       high};
      },
      nb::kw_only(), "num"_a, "degree"_a, "num_spans"_a, "breaks"_a, "coefficients"_a, "first"_a,
      "num_kinks"_a, "kinks"_a, "low"_a, "high"_a);
  m.def("make_spline_surface", &make_spline_surface, nb::kw_only(), "homogeneous"_a, "axes"_a);
  m.def(
      "surface_frames",
      [](const SplineSurface& surface, Address uv, std::int64_t num_points, Address frames) {
        nb::gil_scoped_release release;
        surface_frames(surface, in(uv), num_points, out(frames));
      },
      nb::kw_only(), "surface"_a, "uv"_a, "num_points"_a, "frames"_a);
  m.def(
      "closest_on_surface",
      [](const SplineSurface& surface, nb::sequence num_samples, Address sample_uv,
         Address sample_points, double gap, Address points, std::int64_t num_points, double band,
         Address uv, Address slope, int num_threads) {
        SurfaceSamples samples{{0, 0}, in(sample_uv), in(sample_points), gap};
        for (int k = 0; k < 2; ++k) samples.num[k] = nb::cast<std::int64_t>(num_samples[k]);
        nb::gil_scoped_release release;
        ThreadPool pool(num_threads);
        closest_on_surface(surface, samples, in(points), num_points, band, out(uv), out(slope),
                           pool);
      },
      nb::kw_only(), "surface"_a, "num_samples"_a, "sample_uv"_a, "sample_points"_a, "gap"_a,
      "points"_a, "num_points"_a, "band"_a, "uv"_a, "slope"_a, "num_threads"_a);
  m.def(
      "closest_on_curves",
      [](Address homogeneous, std::int64_t num_curves, int degree, bool closed, double size,
         Address rays, Address points, std::int64_t num_points, Address tau, Address normal) {
        nb::gil_scoped_release release;
        const CurveChain chain{num_curves, degree, in(homogeneous), closed, size, in(rays)};
        closest_on_curves(chain, in(points), num_points, out(tau), out(normal));
      },
      nb::kw_only(), "homogeneous"_a, "num_curves"_a, "degree"_a, "closed"_a, "size"_a, "rays"_a,
      "points"_a, "num_points"_a, "tau"_a, "normal"_a);
}

}  // namespace

void bind_stokes(nb::module_& m) {
  static_assert(sizeof(FlowStats) == 6 * sizeof(double),
                "Python reads stats as (cases, 6) doubles");
  nb::class_<GridShape>(m, "GridShape");
  m.def("make_grid_shape", &make_shape);
  m.attr("STOKES_MAX_DIRECT_NODES") = kMaxDirectNodes;
  nb::enum_<FlowSolver>(m, "FlowSolver")
      .value("auto", FlowSolver::kAuto)
      .value("direct", FlowSolver::kDirect)
      .value("iterative", FlowSolver::kIterative);
  nb::class_<FlowOptions>(m, "FlowOptions")
      .def(nb::init<>())
      .def_rw("slip", &FlowOptions::slip)
      .def_rw("beta", &FlowOptions::beta)
      .def_rw("gamma", &FlowOptions::gamma)
      .def_rw("theta", &FlowOptions::theta)
      .def_rw("ghost_delta", &FlowOptions::ghost_delta)
      .def_rw("volume_delta", &FlowOptions::volume_delta)
      .def_rw("open_epsilon", &FlowOptions::open_epsilon)
      .def_rw("bulk", &FlowOptions::bulk)
      .def_rw("incompressible", &FlowOptions::incompressible)
      .def_rw("solver", &FlowOptions::solver)
      .def_rw("max_direct_nodes", &FlowOptions::max_direct_nodes)
      .def_rw("rtol", &FlowOptions::rtol)
      .def_rw("tolerance", &FlowOptions::tolerance)
      .def_rw("max_iters", &FlowOptions::max_iters);
  nb::class_<StokesArrays>(m, "StokesArrays")
      .def(nb::init<>())
      .def_rw("num_cases", &StokesArrays::num_cases)
      .def_rw("viscosity", &StokesArrays::viscosity)
      .def_rw("prescribed", &StokesArrays::prescribed)
      .def_rw("wall_velocity", &StokesArrays::wall_velocity)
      .def_rw("body_force", &StokesArrays::body_force)
      .def_rw("traction", &StokesArrays::traction)
      .def_rw("wall_velocity_stride", &StokesArrays::wall_velocity_stride)
      .def_rw("body_force_stride", &StokesArrays::body_force_stride)
      .def_rw("traction_stride", &StokesArrays::traction_stride);
  nb::class_<FlowReport>(m, "FlowReport")
      .def_ro("num_cells", &FlowReport::num_cells)
      .def_ro("num_cut_cells", &FlowReport::num_cut_cells)
      .def_ro("num_nodes", &FlowReport::num_nodes)
      .def_ro("num_regions", &FlowReport::num_regions)
      .def_ro("num_loose_regions", &FlowReport::num_loose_regions)
      .def_ro("num_loose_cells", &FlowReport::num_loose_cells)
      .def_ro("factor_nnz", &FlowReport::factor_nnz)
      .def_ro("factor_bytes", &FlowReport::factor_bytes)
      .def_ro("factor_flops", &FlowReport::factor_flops)
      .def_ro("iterative", &FlowReport::iterative)
      .def_ro("solver_bytes", &FlowReport::solver_bytes)
      .def_ro("geometry_s", &FlowReport::geometry_s)
      .def_ro("assembly_s", &FlowReport::assembly_s)
      .def_ro("analysis_s", &FlowReport::analysis_s)
      .def_ro("factor_s", &FlowReport::factor_s);
  nb::class_<StokesPlan>(m, "StokesPlan").def(nb::init<>());
  nb::class_<StokesSystem>(m, "StokesSystem")
      .def_prop_ro("report", &StokesSystem::report)
      .def("fractions",
           [](const StokesSystem& s, Address to, std::int64_t num_cells) {
             std::copy(s.fractions(), s.fractions() + num_cells, out(to));
           })
      .def(
          "solve",
          [](StokesSystem& s, const StokesArrays& inputs, Address velocity, Address pressure,
             Address stats, int num_threads) {
            nb::gil_scoped_release release;
            ThreadPool pool(num_threads);
            s.solve(inputs.inputs(), out(velocity), out(pressure),
                    reinterpret_cast<FlowStats*>(stats), pool);
          },
          nb::kw_only(), "inputs"_a, "velocity"_a, "pressure"_a, "stats"_a, "num_threads"_a)
      .def(
          "equations",
          [](StokesSystem& s, const StokesArrays& inputs, Address velocity, Address pressure,
             Address momentum, Address mass, int num_threads) {
            nb::gil_scoped_release release;
            ThreadPool pool(num_threads);
            s.equations(inputs.inputs(), in(velocity), in(pressure), out(momentum), out(mass),
                        pool);
          },
          nb::kw_only(), "inputs"_a, "velocity"_a, "pressure"_a, "momentum"_a, "mass"_a,
          "num_threads"_a)
      .def(
          "adjoint",
          [](StokesSystem& s, const StokesArrays& inputs, Address velocity, Address pressure,
             Address grad_velocity, Address grad_pressure, Address grad_fraction,
             const StokesArrays& grads, Address grad_phi, Address grad_viscosity, Address stats,
             int num_threads) {
            nb::gil_scoped_release release;
            ThreadPool pool(num_threads);
            const FlowGradients to{
                out(grad_phi),
                out(grad_viscosity),
                out(grads.prescribed),
                {out(grads.wall_velocity), out(grads.body_force), out(grads.traction)}};
            s.adjoint(inputs.inputs(), in(velocity), in(pressure), in(grad_velocity),
                      in(grad_pressure), in(grad_fraction), to, reinterpret_cast<FlowStats*>(stats),
                      pool);
          },
          nb::kw_only(), "inputs"_a, "velocity"_a, "pressure"_a, "grad_velocity"_a,
          "grad_pressure"_a, "grad_fraction"_a, "grads"_a, "grad_phi"_a, "grad_viscosity"_a,
          "stats"_a, "num_threads"_a)
      .def(
          "tangent",
          [](StokesSystem& s, const StokesArrays& inputs, Address velocity, Address pressure,
             const StokesArrays& directions, Address d_phi, Address d_velocity, Address d_pressure,
             Address d_fraction, Address stats, int num_threads) {
            nb::gil_scoped_release release;
            ThreadPool pool(num_threads);
            const FlowInputs rates = directions.inputs();
            const FlowDirections along{in(d_phi), rates.viscosity, rates.prescribed, rates.data};
            s.tangent(inputs.inputs(), in(velocity), in(pressure), along, out(d_velocity),
                      out(d_pressure), out(d_fraction), reinterpret_cast<FlowStats*>(stats), pool);
          },
          nb::kw_only(), "inputs"_a, "velocity"_a, "pressure"_a, "directions"_a, "d_phi"_a,
          "d_velocity"_a, "d_pressure"_a, "d_fraction"_a, "stats"_a, "num_threads"_a);

  // Returns (system, -1, 0), or (None, node * dim + axis, pivot) where K is not positive definite.
  m.def(
      "make_stokes_system",
      [](const GridShape& shape, Address phi, Address fixed, nb::sequence open,
         const FlowOptions& options, StokesPlan& plan, int num_threads) {
        FlowGeometryInputs inputs;
        inputs.shape = shape;
        inputs.phi = in(phi);
        inputs.fixed = reinterpret_cast<const std::uint8_t*>(fixed);
        for (int i = 0; i < 2 * shape.dim; ++i) inputs.open[i] = nb::cast<bool>(open[i]);
        std::shared_ptr<StokesSystem> system;
        std::int64_t unknown = -1;
        double pivot = 0.0;
        {
          nb::gil_scoped_release release;
          ThreadPool pool(num_threads);
          try {
            system = make_stokes_system(inputs, options, plan, pool);
          } catch (const NotPositiveDefinite& e) {
            unknown = e.unknown;
            pivot = e.pivot;
          }
        }
        return nb::make_tuple(system, unknown, pivot);
      },
      nb::kw_only(), "shape"_a, "phi"_a, "fixed"_a, "open"_a, "options"_a, "plan"_a,
      "num_threads"_a);
  bind_closest(m);
  m.def(
      "cut_cells",
      [](const GridShape& shape, Address phi, Address volume, Address area, Address normal,
         int num_threads) {
        nb::gil_scoped_release release;
        ThreadPool pool(num_threads);
        cut_cells(shape, in(phi), out(volume), out(area), out(normal), pool);
      },
      nb::kw_only(), "shape"_a, "phi"_a, "volume"_a, "area"_a, "normal"_a, "num_threads"_a);
  m.def(
      "cut_cells_vjp",
      [](const GridShape& shape, Address phi, Address grad_volume, Address grad_area,
         Address grad_normal, Address grad_phi, int num_threads) {
        nb::gil_scoped_release release;
        ThreadPool pool(num_threads);
        cut_cells_vjp(shape, in(phi), in(grad_volume), in(grad_area), in(grad_normal),
                      out(grad_phi), pool);
      },
      nb::kw_only(), "shape"_a, "phi"_a, "grad_volume"_a, "grad_area"_a, "grad_normal"_a,
      "grad_phi"_a, "num_threads"_a);
  m.def(
      "cut_cells_jvp",
      [](const GridShape& shape, Address phi, Address d_phi, Address d_volume, Address d_area,
         Address d_normal, int num_threads) {
        nb::gil_scoped_release release;
        ThreadPool pool(num_threads);
        cut_cells_jvp(shape, in(phi), in(d_phi), out(d_volume), out(d_area), out(d_normal), pool);
      },
      nb::kw_only(), "shape"_a, "phi"_a, "d_phi"_a, "d_volume"_a, "d_area"_a, "d_normal"_a,
      "num_threads"_a);
  m.def(
      "plane_flux",
      [](const GridShape& shape, Address phi, Address velocity, std::int64_t num_cases, int axis,
         std::int64_t index, Address flux) {
        nb::gil_scoped_release release;
        plane_flux(shape, in(phi), in(velocity), num_cases, axis, index, out(flux));
      },
      nb::kw_only(), "shape"_a, "phi"_a, "velocity"_a, "num_cases"_a, "axis"_a, "index"_a,
      "flux"_a);
  m.def(
      "plane_flux_vjp",
      [](const GridShape& shape, Address phi, Address velocity, std::int64_t num_cases, int axis,
         std::int64_t index, Address grad_flux, Address grad_phi, Address grad_velocity) {
        nb::gil_scoped_release release;
        plane_flux_vjp(shape, in(phi), in(velocity), num_cases, axis, index, in(grad_flux),
                       out(grad_phi), out(grad_velocity));
      },
      nb::kw_only(), "shape"_a, "phi"_a, "velocity"_a, "num_cases"_a, "axis"_a, "index"_a,
      "grad_flux"_a, "grad_phi"_a, "grad_velocity"_a);
  m.def(
      "plane_flux_jvp",
      [](const GridShape& shape, Address phi, Address velocity, Address d_phi, Address d_velocity,
         std::int64_t num_cases, int axis, std::int64_t index, Address d_flux) {
        nb::gil_scoped_release release;
        plane_flux_jvp(shape, in(phi), in(velocity), in(d_phi), in(d_velocity), num_cases, axis,
                       index, out(d_flux));
      },
      nb::kw_only(), "shape"_a, "phi"_a, "velocity"_a, "d_phi"_a, "d_velocity"_a, "num_cases"_a,
      "axis"_a, "index"_a, "d_flux"_a);
}

}  // namespace diffsim
