// Sparse Cholesky factorization; opened to Python by diffsim/linalg/_ops_cholesky.py.
#include "kernels/linalg/cholesky.h"

#include <memory>
#include <utility>

#include "bindings/bindings.h"

namespace diffsim {
namespace {

/// A factor with the workspace of one solve at a time.
class SparseFactor {
 public:
  SparseFactor(std::int64_t num_nodes, Address indptr, Address indices, Address coords, int block,
               bool single)
      : factor_(analyze_cholesky(num_nodes, in_index(indptr), in_index(indices), in(coords), block),
                single ? FactorPrecision::kFloat32 : FactorPrecision::kFloat64) {}

  /// Returns (unknown, pivot) of the failed pivot, or (-1, 0).
  std::pair<std::int64_t, double> refactor(Address values, int num_threads) {
    ThreadPool pool(num_threads);
    try {
      factor_.refactor(in(values), pool);
    } catch (const NotPositiveDefinite& e) {
      return {e.unknown, e.pivot};
    }
    return {-1, 0.0};
  }

  void solve(Address b, Address x, int num_rhs, int num_threads) {
    ThreadPool pool(num_threads);
    factor_.solve(in(b), out(x), num_rhs, workspace_, pool);
  }

  void inverse_among(Address among, std::int64_t count, Address inverse, int num_threads) {
    ThreadPool pool(num_threads);
    factor_.inverse_among(in_index(among), count, out(inverse), workspace_, pool);
  }

  const CholeskyFactor& factor() const { return factor_; }

 private:
  CholeskyFactor factor_;
  CholeskyWorkspace workspace_;
};

}  // namespace

void bind_cholesky(nb::module_& m) {
  nb::class_<SparseFactor>(m, "SparseFactor")
      .def("__init__",
           [](SparseFactor* self, std::int64_t num_nodes, Address indptr, Address indices,
              Address coords, int block, bool single) {
             nb::gil_scoped_release release;
             new (self) SparseFactor(num_nodes, indptr, indices, coords, block, single);
           })
      .def("refactor",
           [](SparseFactor& self, Address values, int num_threads) {
             std::pair<std::int64_t, double> failed;
             {
               nb::gil_scoped_release release;
               failed = self.refactor(values, num_threads);
             }
             return nb::make_tuple(failed.first, failed.second);
           })
      .def("solve", &SparseFactor::solve, nb::call_guard<nb::gil_scoped_release>())
      .def("inverse_among", &SparseFactor::inverse_among, nb::call_guard<nb::gil_scoped_release>())
      .def_prop_ro("usable", [](const SparseFactor& s) { return s.factor().usable(); })
      .def_prop_ro("nnz", [](const SparseFactor& s) { return s.factor().nnz(); })
      .def_prop_ro("bytes", [](const SparseFactor& s) { return s.factor().bytes(); })
      .def_prop_ro("flops", [](const SparseFactor& s) { return s.factor().flops(); });
}

}  // namespace diffsim
