// 3x3 singular value and polar decompositions over arrays; _ops_svd.py checks the arguments.
#include "bindings/bindings.h"
#include "kernels/linalg/batched_svd.h"

namespace diffsim {

void bind_svd(nb::module_& m) {
  m.def("svd3", [](Address F, std::int64_t n, Address U, Address s, Address V, int num_threads) {
    nb::gil_scoped_release release;
    batched_svd3(in(F), n, out(U), out(s), out(V), num_threads);
  });
  m.def("svd3_vjp", [](Address U, Address s, Address V, Address grad_U, Address grad_s,
                       Address grad_V, std::int64_t n, Address grad_F, int num_threads) {
    nb::gil_scoped_release release;
    batched_svd3_vjp(in(U), in(s), in(V), in(grad_U), in(grad_s), in(grad_V), n, out(grad_F),
                     num_threads);
  });
  m.def("polar3", [](Address F, std::int64_t n, Address R, int num_threads) {
    nb::gil_scoped_release release;
    batched_polar3(in(F), n, out(R), num_threads);
  });
  m.def("polar3_vjp", [](Address F, Address R, Address grad_R, std::int64_t n, Address grad_F,
                         int num_threads) {
    nb::gil_scoped_release release;
    batched_polar3_vjp(in(F), in(R), in(grad_R), n, out(grad_F), num_threads);
  });
}

}  // namespace diffsim
