// Signals on their way; diffsim/causes/_ops_signals.py checks the arguments.
#include "bindings/bindings.h"
#include "kernels/signals/follow.h"

namespace diffsim {

namespace {

void bind_follow(nb::module_& m) {
  nb::class_<Followers>(m, "Followers")
      .def(
          "__init__",
          [](Followers* f, int how, std::int64_t num_rows, std::int64_t num_times,
             std::int64_t num_rooms, Address targets, Address room) {
            new (f) Followers{
                static_cast<Follow>(how), num_rows, num_times, in(targets), in(room), num_rooms};
          },
          nb::arg("how"), nb::arg("num_rows"), nb::arg("num_times"), nb::arg("num_rooms"),
          nb::arg("targets"), nb::arg("room"));
  m.def("follow", [](const Followers& f, Address states) {
    nb::gil_scoped_release release;
    follow(f, out(states));
  });
  m.def("follow_vjp", [](const Followers& f, Address states, Address grad_states,
                         Address grad_targets, Address grad_room, Address grad_start) {
    nb::gil_scoped_release release;
    follow_vjp(f, in(states), in(grad_states), out(grad_targets), out(grad_room), out(grad_start));
  });
  m.def("follow_tangent", [](const Followers& f, Address states, Address d_targets, Address d_room,
                             Address d_states) {
    nb::gil_scoped_release release;
    follow_tangent(f, in(states), in(d_targets), in(d_room), out(d_states));
  });
}

void bind_approach(nb::module_& m) {
  m.attr("APPROACH_PARTS") = kParts;
  nb::class_<Approach>(m, "Approach")
      .def(
          "__init__",
          [](Approach* a, std::int64_t num_rows, std::int64_t num_times, bool held, Address targets,
             Address steps, Address most, Address fastest) {
            new (a)
                Approach{num_rows, num_times, in(targets), in(steps), in(most), in(fastest), held};
          },
          nb::arg("num_rows"), nb::arg("num_times"), nb::arg("held"), nb::arg("targets"),
          nb::arg("steps"), nb::arg("most"), nb::arg("fastest"));
  m.def("approach", [](const Approach& a, Address places) {
    nb::gil_scoped_release release;
    approach(a, out(places));
  });
  m.def("approach_vjp", [](const Approach& a, Address grad_places, Address grad_targets,
                           Address grad_most, Address grad_fastest) {
    nb::gil_scoped_release release;
    approach_vjp(a, in(grad_places), out(grad_targets), out(grad_most), out(grad_fastest));
  });
  m.def("approach_tangent", [](const Approach& a, Address d_targets, Address d_most,
                               Address d_fastest, Address d_places) {
    nb::gil_scoped_release release;
    approach_tangent(a, in(d_targets), in(d_most), in(d_fastest), out(d_places));
  });
}

void bind_lines(nb::module_& m) {
  m.def("find_intervals", [](std::int64_t num_times, Address times, std::int64_t num_places,
                             Address places, bool of_equal_after, Address found) {
    nb::gil_scoped_release release;
    find_intervals(num_times, in(times), num_places, in(places), of_equal_after, out_index(found));
  });
  nb::class_<Lines>(m, "Lines")
      .def(
          "__init__",
          [](Lines* l, std::int64_t num_rows, std::int64_t num_times, std::int64_t num_places,
             std::int64_t num_signals, std::int64_t num_ways, bool both_sides, Address values,
             Address times, Address places) {
            const std::int64_t value_stride = num_signals > 1 ? num_times : 0;
            const std::int64_t place_stride = num_ways > 1 ? num_places : 0;
            new (l) Lines{num_rows,   num_times,    num_places,   in(values), in(times),
                          in(places), value_stride, place_stride, both_sides};
          },
          nb::arg("num_rows"), nb::arg("num_times"), nb::arg("num_places"), nb::arg("num_signals"),
          nb::arg("num_ways"), nb::arg("both_sides"), nb::arg("values"), nb::arg("times"),
          nb::arg("places"));
  m.def("read_lines", [](const Lines& l, Address readings) {
    nb::gil_scoped_release release;
    read_lines(l, out(readings));
  });
  m.def("read_lines_vjp",
        [](const Lines& l, Address grad_readings, Address grad_values, Address grad_places) {
          nb::gil_scoped_release release;
          read_lines_vjp(l, in(grad_readings), out(grad_values), out(grad_places));
        });
  m.def("read_lines_tangent",
        [](const Lines& l, Address d_values, Address d_places, Address d_readings) {
          nb::gil_scoped_release release;
          read_lines_tangent(l, in(d_values), in(d_places), out(d_readings));
        });
}

}  // namespace

void bind_signals(nb::module_& m) {
  bind_follow(m);
  bind_approach(m);
  bind_lines(m);
}

}  // namespace diffsim
