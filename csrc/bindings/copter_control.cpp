// Hover thrusts, Lyapunov and Riccati equations; diffsim/copter/dynamics checks the arguments.
#include <Eigen/Core>

#include "bindings/bindings.h"
#include "kernels/copter/hover.h"
#include "kernels/copter/riccati.h"
#include "kernels/parallel.h"

namespace diffsim {
namespace {

using namespace nb::literals;

using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

Eigen::MatrixXd matrix(Address a, std::int64_t index, std::int64_t rows) {
  return Eigen::Map<const RowMajor>(in(a) + index * rows * rows, rows, rows);
}

void store(const Eigen::MatrixXd& X, Address a, std::int64_t index, std::int64_t rows) {
  Eigen::Map<RowMajor>(out(a) + index * rows * rows, rows, rows) = X;
}

/// Problem `index` of a batch stored one after the other.
HoverProblem hover_problem(Address force, Address torque, Address weights, Address upper,
                           double barrier, int num_rotors, std::int64_t index) {
  return {num_rotors,
          in(force) + index * 3 * num_rotors,
          in(torque) + index * 3 * num_rotors,
          in(weights) + index * num_rotors,
          in(upper) + index * num_rotors,
          barrier};
}

}  // namespace

void bind_copter_control(nb::module_& m) {
  m.attr("HOVER_FEASIBLE") = kFeasible;
  m.def(
      "hover",
      [](Address force, Address torque, Address weights, Address upper, double barrier,
         std::int64_t batch, int num_rotors, Address thrusts, Address multipliers, Address state,
         Address info, int num_threads) {
        nb::gil_scoped_release release;
        ThreadPool pool(num_threads);
        const int n = num_rotors;
        pool.run(batch, [&](std::int64_t b) {
          solve_hover(hover_problem(force, torque, weights, upper, barrier, n, b),
                      out(thrusts) + b * n, out(multipliers) + b * 4, out_index(state) + b * n,
                      out_index(info) + b * kHoverInfo);
        });
      },
      nb::kw_only(), "force"_a, "torque"_a, "weights"_a, "upper"_a, "barrier"_a, "batch"_a,
      "num_rotors"_a, "thrusts"_a, "multipliers"_a, "state"_a, "info"_a, "num_threads"_a);
  m.def(
      "hover_vjp",
      [](Address force, Address torque, Address weights, Address upper, double barrier,
         std::int64_t batch, int num_rotors, Address thrusts, Address multipliers, Address state,
         Address info, Address grad_thrusts, Address grad_force, Address grad_torque,
         Address grad_weights, Address grad_upper, int num_threads) {
        nb::gil_scoped_release release;
        ThreadPool pool(num_threads);
        const int n = num_rotors;
        pool.run(batch, [&](std::int64_t b) {
          solve_hover_vjp(hover_problem(force, torque, weights, upper, barrier, n, b),
                          in(thrusts) + b * n, in(multipliers) + b * 4, in_index(state) + b * n,
                          in_index(info) + b * kHoverInfo, in(grad_thrusts) + b * n,
                          out(grad_force) + b * 3 * n, out(grad_torque) + b * 3 * n,
                          out(grad_weights) + b * n, out(grad_upper) + b * n);
        });
      },
      nb::kw_only(), "force"_a, "torque"_a, "weights"_a, "upper"_a, "barrier"_a, "batch"_a,
      "num_rotors"_a, "thrusts"_a, "multipliers"_a, "state"_a, "info"_a, "grad_thrusts"_a,
      "grad_force"_a, "grad_torque"_a, "grad_weights"_a, "grad_upper"_a, "num_threads"_a);
  m.def(
      "hover_tangent",
      [](Address force, Address torque, Address weights, Address upper, double barrier,
         std::int64_t batch, int num_rotors, Address thrusts, Address multipliers, Address state,
         Address info, Address d_force, Address d_torque, Address d_weights, Address d_upper,
         Address d_thrusts, int num_threads) {
        nb::gil_scoped_release release;
        ThreadPool pool(num_threads);
        const int n = num_rotors;
        pool.run(batch, [&](std::int64_t b) {
          const HoverDirection direction{in(d_force) + b * 3 * n, in(d_torque) + b * 3 * n,
                                         in(d_weights) + b * n, in(d_upper) + b * n};
          solve_hover_tangent(hover_problem(force, torque, weights, upper, barrier, n, b),
                              in(thrusts) + b * n, in(multipliers) + b * 4, in_index(state) + b * n,
                              in_index(info) + b * kHoverInfo, direction, out(d_thrusts) + b * n);
        });
      },
      nb::kw_only(), "force"_a, "torque"_a, "weights"_a, "upper"_a, "barrier"_a, "batch"_a,
      "num_rotors"_a, "thrusts"_a, "multipliers"_a, "state"_a, "info"_a, "d_force"_a, "d_torque"_a,
      "d_weights"_a, "d_upper"_a, "d_thrusts"_a, "num_threads"_a);
  m.def(
      "lyapunov",
      [](Address A, Address Q, std::int64_t batch, std::int64_t size, Address X, Address solved,
         int num_threads) {
        nb::gil_scoped_release release;
        ThreadPool pool(num_threads);
        pool.run(batch, [&](std::int64_t b) {
          Eigen::MatrixXd solution = Eigen::MatrixXd::Zero(size, size);
          out_index(solved)[b] = solve_lyapunov(matrix(A, b, size), matrix(Q, b, size), solution);
          store(solution, X, b, size);
        });
      },
      nb::kw_only(), "A"_a, "Q"_a, "batch"_a, "size"_a, "X"_a, "solved"_a, "num_threads"_a);
  m.def(
      "care",
      [](Address A, Address G, Address Q, std::int64_t batch, std::int64_t size, Address P,
         Address report, int num_threads) {
        nb::gil_scoped_release release;
        ThreadPool pool(num_threads);
        pool.run(batch, [&](std::int64_t b) {
          Eigen::MatrixXd solution;
          const CareReport r =
              solve_care(matrix(A, b, size), matrix(G, b, size), matrix(Q, b, size), solution);
          store(solution, P, b, size);
          double* row = out(report) + b * 4;
          row[0] = r.solved;
          row[1] = r.num_iters;
          row[2] = r.residual;
          row[3] = r.abscissa;
        });
      },
      nb::kw_only(), "A"_a, "G"_a, "Q"_a, "batch"_a, "size"_a, "P"_a, "report"_a, "num_threads"_a);
}

}  // namespace diffsim
