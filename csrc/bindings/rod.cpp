// Equilibria of slender rods; diffsim/systems/rod/_ops.py checks the arguments.
#include "kernels/rod/rod.h"

#include "bindings/bindings.h"

namespace diffsim {

namespace {

/// An address and the lengths of the two leading axes, as Python gives them.
template <class Number>
rod::Rows<Number> rows_of(nb::handle given) {
  return {reinterpret_cast<Number*>(nb::cast<Address>(given[0])), nb::cast<std::int64_t>(given[1]),
          nb::cast<std::int64_t>(given[2])};
}

template <class Number>
rod::Fields<Number> fields_of(const nb::sequence& given) {
  rod::Fields<Number> fields;
  for (int f = 0; f < rod::kNumFields; ++f) fields[f] = rows_of<Number>(given[f]);
  return fields;
}

/// A batch whose memory Python keeps alive while the object lives.
struct RodBatch {
  rod::Batch batch;
  RodBatch(Address edges, Address radius, Address point_at, Address around,
           std::int64_t num_elements, std::int64_t num_tendons, std::int64_t num_loads,
           std::int64_t num_points, std::int64_t rows, std::int64_t columns, int num_threads,
           const nb::sequence& fields)
      : batch{{num_elements, num_tendons, num_loads, num_points, in(edges), in(radius),
               in(point_at), in_index(around)},
              fields_of<const double>(fields),
              rows,
              columns,
              num_threads} {}
};

}  // namespace

void bind_rod(nb::module_& m) {
  m.attr("ROD_MOST_STEPS") = rod::kMostSteps;
  nb::class_<RodBatch>(m, "RodBatch")
      .def(nb::init<Address, Address, Address, Address, std::int64_t, std::int64_t, std::int64_t,
                    std::int64_t, std::int64_t, std::int64_t, int, nb::sequence>(),
           nb::arg("edges"), nb::arg("radius"), nb::arg("point_at"), nb::arg("around"),
           nb::arg("num_elements"), nb::arg("num_tendons"), nb::arg("num_loads"),
           nb::arg("num_points"), nb::arg("rows"), nb::arg("columns"), nb::arg("num_threads"),
           nb::arg("fields"));
  m.def("rod_solve", [](const RodBatch& b, double tolerance, bool from_straight,
                        const nb::sequence& start, Address strains, Address places, Address turns) {
    const auto guess = rows_of<const double>(start);
    nb::gil_scoped_release release;
    rod::solve(b.batch, {tolerance, from_straight}, guess, out(strains), out(places), out(turns));
  });
  m.def("rod_solve_vjp", [](const RodBatch& b, Address strains, Address grad_strains,
                            Address grad_places, const nb::sequence& grads) {
    const auto fields = fields_of<double>(grads);
    nb::gil_scoped_release release;
    rod::solve_vjp(b.batch, in(strains), in(grad_strains), in(grad_places), fields);
  });
  m.def("rod_solve_tangent", [](const RodBatch& b, const nb::sequence& directions, Address strains,
                                Address d_strains, Address d_places) {
    const auto fields = fields_of<const double>(directions);
    nb::gil_scoped_release release;
    rod::solve_tangent(b.batch, fields, in(strains), out(d_strains), out(d_places));
  });
  m.def("rod_survey", [](const RodBatch& b, Address strains, Address frames, Address nodes,
                         Address stretches, Address tensions, Address residual) {
    nb::gil_scoped_release release;
    rod::survey(b.batch, in(strains), out(frames), out(nodes), out(stretches), out(tensions),
                out(residual));
  });
}

}  // namespace diffsim
