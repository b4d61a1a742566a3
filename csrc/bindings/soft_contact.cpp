// The implicit step of a soft body with non-penetration and Coulomb friction, and its adjoint.
#include <nanobind/stl/shared_ptr.h>

#include "bindings/bindings.h"
#include "bindings/soft_arrays.h"
#include "kernels/soft/contact/contact_cone.h"
#include "kernels/soft/contact/contact_step.h"

namespace diffsim {
namespace {

/// Addresses that Python fills by name; zero means absent.
struct ContactArrays {
  std::int64_t num_contacts = 0;
  Address node = 0, normal = 0, reference = 0, offset = 0, friction = 0, force_guess = 0;

  ContactInputs inputs() const {
    ContactInputs contacts;
    contacts.num_contacts = num_contacts;
    contacts.node = in_index(node);
    contacts.normal = in(normal);
    contacts.reference = in(reference);
    contacts.offset = in(offset);
    contacts.friction = in(friction);
    contacts.force_guess = in(force_guess);
    return contacts;
  }
  ContactAdjoint adjoint() const {
    ContactAdjoint grads;
    grads.normal = out(normal);
    grads.reference = out(reference);
    grads.offset = out(offset);
    grads.friction = out(friction);
    return grads;
  }
  ContactRates rates() const {
    ContactRates d;
    d.normal = in(normal);
    d.reference = in(reference);
    d.offset = in(offset);
    d.friction = in(friction);
    return d;
  }
};

}  // namespace

void bind_soft_contact(nb::module_& m) {
  // Of a step's inside, so that its closed forms can be asked; W symmetric.
  m.def(
      "contact_cones",
      [](std::int64_t size, Address W, Address free, Address normal, Address offset,
         Address friction, Address force) {
        nb::gil_scoped_release release;
        ConeProblem problem(size);
        problem.W = Eigen::Map<const Eigen::MatrixXd>(in(W), 3 * size, 3 * size);
        problem.free = Eigen::Map<const Eigen::VectorXd>(in(free), 3 * size);
        problem.normal = Eigen::Map<const Eigen::Matrix3Xd>(in(normal), 3, size);
        problem.offset = Eigen::Map<const Eigen::VectorXd>(in(offset), size);
        problem.friction = Eigen::Map<const Eigen::VectorXd>(in(friction), size);
        Eigen::VectorXd found = Eigen::VectorXd::Zero(3 * size);
        const bool settled = solve_cones(problem, found);
        Eigen::Map<Eigen::VectorXd>(out(force), 3 * size) = found;
        return settled;
      },
      nb::kw_only(), nb::arg("size"), nb::arg("W"), nb::arg("free"), nb::arg("normal"),
      nb::arg("offset"), nb::arg("friction"), nb::arg("force"));
  nb::class_<ContactArrays>(m, "ContactArrays", nb::dynamic_attr())  // holds the tensors
      .def(nb::init<>())
      .def_rw("num_contacts", &ContactArrays::num_contacts)
      .def_rw("node", &ContactArrays::node)
      .def_rw("normal", &ContactArrays::normal)
      .def_rw("reference", &ContactArrays::reference)
      .def_rw("offset", &ContactArrays::offset)
      .def_rw("friction", &ContactArrays::friction)
      .def_rw("force_guess", &ContactArrays::force_guess);

  m.def(
      "contact_step",
      [](const ConstantSystem& system, const SoftArrays& inputs, const ContactArrays& contacts,
         const StepOptions& options, bool cache_columns, std::int64_t batch, Address x,
         Address force, Address status, Address stats, int num_threads) {
        nb::gil_scoped_release release;
        contact_step_batch(system, inputs.inputs(), contacts.inputs(), options, {cache_columns},
                           batch, out(x), out(force), out_index(status),
                           reinterpret_cast<StepStats*>(stats), num_threads);
      },
      nb::kw_only(), nb::arg("system"), nb::arg("inputs"), nb::arg("contacts"), nb::arg("options"),
      nb::arg("cache_columns"), nb::arg("batch"), nb::arg("x"), nb::arg("force"), nb::arg("status"),
      nb::arg("stats"), nb::arg("num_threads"));
  m.def(
      "contact_step_adjoint",
      [](const ConstantSystem& system, const SoftArrays& inputs, const ContactArrays& contacts,
         const StepOptions& options, bool cache_columns, std::int64_t batch, Address x,
         Address status, Address grad_x, Address grad_force, const SoftArrays& grads,
         const ContactArrays& contact_grads, Address stats, int num_threads) {
        nb::gil_scoped_release release;
        contact_step_adjoint_batch(system, inputs.inputs(), contacts.inputs(), options,
                                   {cache_columns}, batch, in(x), in_index(status), in(grad_x),
                                   in(grad_force), grads.adjoint(), contact_grads.adjoint(),
                                   reinterpret_cast<StepStats*>(stats), num_threads);
      },
      nb::kw_only(), nb::arg("system"), nb::arg("inputs"), nb::arg("contacts"), nb::arg("options"),
      nb::arg("cache_columns"), nb::arg("batch"), nb::arg("x"), nb::arg("status"),
      nb::arg("grad_x"), nb::arg("grad_force"), nb::arg("grads"), nb::arg("contact_grads"),
      nb::arg("stats"), nb::arg("num_threads"));
  m.def(
      "contact_step_tangent",
      [](const ConstantSystem& system, const SoftArrays& inputs, const ContactArrays& contacts,
         const StepOptions& options, bool cache_columns, Address x, Address status,
         const SoftArrays& directions, const ContactArrays& contact_directions, Address dx,
         Address dforce, Address stats, int num_threads) {
        nb::gil_scoped_release release;
        ThreadPool pool(num_threads);
        *reinterpret_cast<StepStats*>(stats) =
            contact_step_tangent(system, inputs.inputs(), contacts.inputs(), options,
                                 {cache_columns}, in(x), in_index(status), directions.directions(1),
                                 contact_directions.rates(), out(dx), out(dforce), pool);
      },
      nb::kw_only(), nb::arg("system"), nb::arg("inputs"), nb::arg("contacts"), nb::arg("options"),
      nb::arg("cache_columns"), nb::arg("x"), nb::arg("status"), nb::arg("directions"),
      nb::arg("contact_directions"), nb::arg("dx"), nb::arg("dforce"), nb::arg("stats"),
      nb::arg("num_threads"));
}

}  // namespace diffsim
