// Soft bodies: pattern, constant system, implicit step and its adjoint, elastic forces.
#include <nanobind/stl/shared_ptr.h>

#include "bindings/bindings.h"
#include "bindings/soft_arrays.h"
#include "kernels/soft/elastic_force.h"
#include "kernels/soft/material.h"

namespace diffsim {
namespace {

void bind_arrays(nb::module_& m) {
  nb::class_<SoftArrays>(m, "SoftArrays", nb::dynamic_attr())  // holds the tensors
      .def(nb::init<>())
      .def_rw("per_member", &SoftArrays::per_member)
      .def_rw("weights", &SoftArrays::weights)
      .def_rw("fiber_stiffness", &SoftArrays::fiber_stiffness)
      .def_rw("activation", &SoftArrays::activation)
      .def_rw("damp_mu", &SoftArrays::damp_mu)
      .def_rw("damp_lambda", &SoftArrays::damp_lambda)
      .def_rw("pressure", &SoftArrays::pressure)
      .def_rw("tables", &SoftArrays::tables)
      .def_rw("y", &SoftArrays::y)
      .def_rw("force", &SoftArrays::force)
      .def_rw("target", &SoftArrays::target)
      .def_rw("guess", &SoftArrays::guess)
      .def_rw("inertia", &SoftArrays::inertia)
      .def_rw("x_frame", &SoftArrays::x_frame)
      .def_rw("x_velocity", &SoftArrays::x_velocity);
  nb::class_<StepOptions>(m, "StepOptions")
      .def(nb::init<>())
      .def_rw("rtol", &StepOptions::rtol)
      .def_rw("atol", &StepOptions::atol)
      .def_rw("max_iters", &StepOptions::max_iters)
      .def_rw("keep", &StepOptions::keep)
      .def_rw("method", &StepOptions::method);
  nb::enum_<StepMethod>(m, "StepMethod")
      .value("auto", StepMethod::kAuto)
      .value("quasi_newton", StepMethod::kQuasiNewton)
      .value("newton_pcg", StepMethod::kNewtonPcg)
      .value("newton_jacobi", StepMethod::kNewtonJacobi)
      .value("newton_cholesky", StepMethod::kNewtonCholesky)
      .value("linearly_implicit", StepMethod::kLinearlyImplicit);
}

void bind_prepared(nb::module_& m) {
  nb::class_<SoftPattern>(m, "SoftPattern")
      .def_prop_ro("num_nodes", [](const SoftPattern& p) { return p.model().num_nodes; })
      .def_prop_ro("num_weights", [](const SoftPattern& p) { return p.model().num_weights; })
      .def_prop_ro("num_tables", [](const SoftPattern& p) { return p.model().tables_size(); })
      .def_prop_ro("num_blocks", [](const SoftPattern& p) { return p.model().num_blocks(); });
  nb::class_<ConstantSystem>(m, "ConstantSystem")
      .def_prop_ro("plan",
                   [](const ConstantSystem& s) {
                     const SolverPlan& p = s.plan();
                     return nb::make_tuple(p.iterations, p.iteration_cost, p.tangent_cost,
                                           p.factorize_cost);
                   })
      .def_prop_ro("preconditioner",
                   [](const ConstantSystem& s) { return s.plan().preconditioner; });
  nb::enum_<ElementKind>(m, "ElementKind")
      .value("hex", ElementKind::kHex)
      .value("tet", ElementKind::kTet)
      .value("mean_hex", ElementKind::kMeanHex)
      .value("eighth_tet", ElementKind::kEighthTet);
  nb::enum_<Preconditioner>(m, "Preconditioner")
      .value("auto", Preconditioner::kAuto)
      .value("constant", Preconditioner::kConstant)
      .value("multigrid", Preconditioner::kMultigrid);

  m.def(
      "make_soft_pattern",
      [](ElementKind kind, const char* material, std::int64_t num_nodes, std::int64_t num_elements,
         std::int64_t num_classes, std::int64_t num_fibers, std::int64_t num_chambers,
         std::int64_t num_lids, Address elements, Address grad, Address weight, Address hourglass,
         Address class_idx, Address coords, Address fiber_elements, Address fiber_directions,
         Address fiber_pull_only, Address chamber_start, Address chamber_faces, Address lid_chamber,
         Address lid_start, Address lid_nodes) {
        nb::gil_scoped_release release;
        MeshTables t;
        t.kind = kind;
        t.hourglass = in(hourglass);
        t.material = find_material(material);
        t.num_nodes = num_nodes;
        t.num_elements = num_elements;
        t.num_classes = num_classes;
        t.num_fibers = num_fibers;
        t.elements = in_index(elements);
        t.grad = in(grad);
        t.weight = in(weight);
        t.class_idx = in_index(class_idx);
        t.coords = in(coords);
        t.fiber_elements = in_index(fiber_elements);
        t.fiber_directions = in(fiber_directions);
        t.fiber_pull_only = in(fiber_pull_only);
        t.chambers = {num_chambers,
                      num_lids,
                      in_index(chamber_start),
                      in_index(chamber_faces),
                      in_index(lid_chamber),
                      in_index(lid_start),
                      in_index(lid_nodes)};
        return std::make_shared<SoftPattern>(make_soft_model(t), t.coords);
      },
      nb::kw_only(), nb::arg("kind"), nb::arg("material"), nb::arg("num_nodes"),
      nb::arg("num_elements"), nb::arg("num_classes"), nb::arg("num_fibers"),
      nb::arg("num_chambers"), nb::arg("num_lids"), nb::arg("elements"), nb::arg("grad"),
      nb::arg("weight"), nb::arg("hourglass"), nb::arg("class_idx"), nb::arg("coords"),
      nb::arg("fiber_elements"), nb::arg("fiber_directions"), nb::arg("fiber_pull_only"),
      nb::arg("chamber_start"), nb::arg("chamber_faces"), nb::arg("lid_chamber"),
      nb::arg("lid_start"), nb::arg("lid_nodes"));

  m.def(
      "make_constant_system",
      // Returns (system, -1, 0), or (None, unknown, pivot) where A is not positive definite.
      [](std::shared_ptr<SoftPattern> pattern, Address fixed, Address inertia, Address kappa,
         Address fiber_kappa, const SoftArrays& parameters, Preconditioner preconditioner,
         bool in_contact, int num_threads) {
        std::shared_ptr<ConstantSystem> system;
        std::int64_t unknown = -1;
        double pivot = 0.0;
        {
          nb::gil_scoped_release release;
          ThreadPool pool(num_threads);
          const ConstantSystemInputs inputs{reinterpret_cast<const std::uint8_t*>(fixed),
                                            in(inertia),
                                            in(kappa),
                                            in(fiber_kappa),
                                            parameters.inputs().parameters,
                                            preconditioner,
                                            in_contact};
          try {
            system = std::make_shared<ConstantSystem>(std::move(pattern), inputs, pool);
          } catch (const NotPositiveDefinite& e) {
            unknown = e.unknown;
            pivot = e.pivot;
          }
        }
        return nb::make_tuple(system, unknown, pivot);
      },
      nb::arg("pattern"), nb::kw_only(), nb::arg("fixed"), nb::arg("inertia"), nb::arg("kappa"),
      nb::arg("fiber_kappa"), nb::arg("parameters"), nb::arg("preconditioner"),
      nb::arg("in_contact"), nb::arg("num_threads"));
}

}  // namespace

void bind_soft(nb::module_& m) {
  bind_arrays(m);
  bind_prepared(m);

  static_assert(sizeof(StepStats) == 12 * sizeof(double),
                "Python reads stats as (batch, 12) doubles");
  m.def(
      "implicit_step",
      [](const ConstantSystem& system, const SoftArrays& inputs, const StepOptions& options,
         std::int64_t batch, Address x, Address stats, int num_threads) {
        nb::gil_scoped_release release;
        implicit_step_batch(system, inputs.inputs(), options, batch, out(x),
                            reinterpret_cast<StepStats*>(stats), num_threads);
      },
      nb::kw_only(), nb::arg("system"), nb::arg("inputs"), nb::arg("options"), nb::arg("batch"),
      nb::arg("x"), nb::arg("stats"), nb::arg("num_threads"));
  m.def(
      "implicit_step_adjoint",
      [](const ConstantSystem& system, const SoftArrays& inputs, const StepOptions& options,
         std::int64_t batch, Address x, Address grad_x, const SoftArrays& grads, Address stats,
         int num_threads) {
        nb::gil_scoped_release release;
        implicit_step_adjoint_batch(system, inputs.inputs(), options, batch, in(x), in(grad_x),
                                    grads.adjoint(), reinterpret_cast<StepStats*>(stats),
                                    num_threads);
      },
      nb::kw_only(), nb::arg("system"), nb::arg("inputs"), nb::arg("options"), nb::arg("batch"),
      nb::arg("x"), nb::arg("grad_x"), nb::arg("grads"), nb::arg("stats"), nb::arg("num_threads"));
  m.def(
      "implicit_step_tangent",
      [](const ConstantSystem& system, const SoftArrays& inputs, const StepOptions& options,
         std::int64_t count, Address x, const SoftArrays& directions, Address dx, Address stats,
         int num_threads) {
        nb::gil_scoped_release release;
        ThreadPool pool(num_threads);
        *reinterpret_cast<StepStats*>(stats) = implicit_step_tangent(
            system, inputs.inputs(), options, in(x), directions.directions(count), out(dx), pool);
      },
      nb::kw_only(), nb::arg("system"), nb::arg("inputs"), nb::arg("options"), nb::arg("count"),
      nb::arg("x"), nb::arg("directions"), nb::arg("dx"), nb::arg("stats"), nb::arg("num_threads"));
  m.def(
      "elastic_gradient",
      [](const SoftPattern& pattern, const SoftArrays& inputs, std::int64_t batch, Address x,
         Address gradient, Address energy, int num_threads) {
        nb::gil_scoped_release release;
        elastic_gradient(pattern.model(), inputs.inputs(), batch, in(x), out(gradient), out(energy),
                         num_threads);
      },
      nb::kw_only(), nb::arg("pattern"), nb::arg("inputs"), nb::arg("batch"), nb::arg("x"),
      nb::arg("gradient"), nb::arg("energy"), nb::arg("num_threads"));
  m.def(
      "elastic_gradient_adjoint",
      [](const SoftPattern& pattern, const SoftArrays& inputs, Address x, Address z, Address grad_x,
         const SoftArrays& grads, int num_threads) {
        nb::gil_scoped_release release;
        elastic_gradient_adjoint(pattern.model(), inputs.inputs(), in(x), in(z), out(grad_x),
                                 grads.adjoint().parameters, num_threads);
      },
      nb::kw_only(), nb::arg("pattern"), nb::arg("inputs"), nb::arg("x"), nb::arg("z"),
      nb::arg("grad_x"), nb::arg("grads"), nb::arg("num_threads"));
  m.def(
      "elastic_energy_slopes",
      [](const SoftPattern& pattern, const SoftArrays& inputs, Address x, const SoftArrays& slopes,
         int num_threads) {
        nb::gil_scoped_release release;
        elastic_energy_slopes(pattern.model(), inputs.inputs(), in(x), slopes.adjoint().parameters,
                              num_threads);
      },
      nb::kw_only(), nb::arg("pattern"), nb::arg("inputs"), nb::arg("x"), nb::arg("slopes"),
      nb::arg("num_threads"));
  m.def(
      "elastic_gradient_tangent",
      [](const SoftPattern& pattern, const SoftArrays& inputs, Address x, Address dx,
         const SoftArrays& directions, Address tangent, int num_threads) {
        nb::gil_scoped_release release;
        elastic_gradient_tangent(pattern.model(), inputs.inputs(), in(x), in(dx),
                                 directions.directions(1).parameters, out(tangent), num_threads);
      },
      nb::kw_only(), nb::arg("pattern"), nb::arg("inputs"), nb::arg("x"), nb::arg("dx"),
      nb::arg("directions"), nb::arg("tangent"), nb::arg("num_threads"));
  m.def("count_inverted", [](const SoftPattern& pattern, Address x) {
    nb::gil_scoped_release release;
    return count_inverted(pattern.model(), in(x));
  });
}

}  // namespace diffsim
