#include "kernels/soft/solver_plan.h"

#include <cmath>
#include <limits>

#include "kernels/soft/rigid_rotations.h"
#include "kernels/soft/step_problem.h"

namespace diffsim {
namespace {

// A 2-core cloud machine (AMD EPYC, Zen 5); see benchmarks/soft.py.
constexpr double kCacheBytesPerSecond = 5e10, kMemoryBytesPerSecond = 2.5e10, kCacheBytes = 3.2e7;
constexpr double kFlopsPerSecond = 6e10 * kNativeBytes / 64.0;
// A factor of the tangent above this is not worth its memory (its work arrays need as much again).
constexpr double kMaxFactorBytes = 4e9;
// Beyond so many nodes multigrid does not ask what a factor would cost: the analysis alone would
// take longer than a step.
constexpr std::int64_t kMostAnalyzedNodes = 150000;
constexpr int kMaxProbe = 400, kLeastProbe = 20;
constexpr double kProbeTolerance = 1e-2;  // of the right-hand side: kProbeDigits

// Below this a factor of the tangent is cheaper still.
constexpr std::int64_t kLeastMultigridNodes = 300;
// Matrices in float32 that a cycle streams, with the transfers and the coarse levels, and products
// that making one amounts to.
constexpr double kCycleProducts = 6.0, kSetupProducts = 30.0;

struct Probe {
  int preconditioned, rotating, jacobi;
};

/// Iterations to kProbeTolerance at rest, for a smooth right-hand side; the body's rotations beside
/// the constant factor, and 3x3 diagonal blocks, are tried for steps in contact only.
Probe probe(const ConstantSystem& system, const ConstantSystemInputs& made_of,
            Preconditioner preconditioner, int limit, const std::function<int(int)>& jacobi_limit,
            ThreadPool& pool) {
  const SoftModel& model = system.model();
  const std::size_t size = static_cast<std::size_t>(3 * model.num_nodes);
  const Vector rest(system.pattern().coords(), system.pattern().coords() + size);
  const Vector zero(size, 0.0);
  const Vector one(static_cast<std::size_t>(model.fiber.num_elements), 1.0);
  StepInputs inputs;
  inputs.parameters = made_of.parameters;
  inputs.parameters.activation = one.data();
  inputs.y = inputs.target = inputs.guess = inputs.x_frame = inputs.x_velocity = rest.data();
  inputs.force = zero.data();
  StepProblem problem(system, inputs, pool, preconditioner == Preconditioner::kMultigrid);
  problem.assemble(rest, false);
  Vector b(size), x;
  std::uint64_t random = 1;
  for (double& v : b) {
    random = random * 6364136223846793005u + 1442695040888963407u;  // Knuth's MMIX generator
    v = static_cast<double>(random >> 11) * 0x1p-53 - 0.5;
  }
  problem.zero_fixed(b);
  KrylovScratch scratch;
  const auto apply = [&](const Vector& in, Vector& out) { problem.multiply(in, out); };
  const auto precondition = [&](const Vector& in, Vector& out) { problem.precondition(in, out); };
  // b is rough; a smooth right-hand side is what steps have.
  Vector smooth;
  problem.precondition(b, smooth);
  for (std::size_t i = 0; i < size; ++i) smooth[i] *= system.inertia()[i / 3];
  const Vector& rhs = problem.ops().norm(smooth) > 0.0 ? smooth : b;
  const auto jacobi = [&](const Vector& in, Vector& out) { problem.solve_jacobi(in, out); };
  // Cut off where a factor would have paid already; by how much more is not worth finding out.
  const auto count = [&](const auto& inverse, int most) {
    const KrylovResult result = conjugate_gradients(apply, inverse, rhs, x, false,
                                                    kProbeTolerance * problem.ops().norm(rhs), most,
                                                    scratch, problem.ops());
    return result.converged ? result.num_iters : 4 * most;
  };
  const int found = count(precondition, limit);
  if (!made_of.in_contact) return {found, 0, 0};
  if (preconditioner == Preconditioner::kMultigrid)
    return {found, found, count(jacobi, jacobi_limit(found))};
  RigidRotations rotations;
  rotations.prepare(problem, system, rest);
  const auto rotating = [&](const Vector& in, Vector& out) {
    problem.precondition(in, out);
    rotations.add(in, out, problem.ops());
  };
  return {found, count(rotating, limit), count(jacobi, jacobi_limit(found))};
}

}  // namespace

double streaming_cost(double bytes) {
  return bytes / (bytes < kCacheBytes ? kCacheBytesPerSecond : kMemoryBytesPerSecond);
}

double flop_cost(double flops) { return flops / kFlopsPerSecond; }

double decades(double rtol) { return std::max(1.0, -std::log10(rtol)); }

bool SolverPlan::factorize_step(double rtol) const {
  // over all Newton iterations of a step
  const double total = iterations / kProbeDigits * decades(rtol);
  return total * iteration_cost + kSetupsPerStep * setup_cost >
         factorize_cost + kTangentIterations * tangent_cost;
}

double SolverPlan::contact_cost(double rtol) const {
  return kSetupsPerStep * setup_cost +
         contact_iterations / kProbeDigits * decades(rtol) * iteration_cost;
}

double SolverPlan::answer_iterations(double at_rest, double rtol) {
  return at_rest * (0.6 + 0.22 * decades(rtol));
}

double SolverPlan::factorized_cost(double count) const {
  return factorize_cost + 2.0 * count * tangent_cost;
}

bool SolverPlan::factorize_adjoint(double rtol, double count) const {
  return count * answer_iterations(iterations, rtol) * iteration_cost + setup_cost >
         factorized_cost(count);
}

int SolverPlan::patience(double cost) const {
  return static_cast<int>(std::min(2.0 * factorize_cost / cost + 50.0, 1e9));
}

int SolverPlan::refactor_after() const {
  return static_cast<int>(std::min(factorize_cost / tangent_cost + 5.0, 1e9));
}

bool suits_multigrid(const SoftModel& model) { return model.num_nodes >= kLeastMultigridNodes; }

SolverPlan make_solver_plan(const ConstantSystem& system, const ConstantSystemInputs& inputs,
                            Preconditioner preconditioner, ThreadPool& pool) {
  SolverPlan plan;
  plan.preconditioner = preconditioner;
  const double matrix_bytes = 8.0 * static_cast<double>(system.model().values_size());
  const bool by_multigrid = preconditioner == Preconditioner::kMultigrid;
  if (by_multigrid) {
    plan.iteration_cost = streaming_cost((1.0 + 0.5 * kCycleProducts) * matrix_bytes);
    plan.setup_cost = streaming_cost(0.5 * kSetupProducts * matrix_bytes);
  } else {
    plan.iteration_cost =
        streaming_cost(matrix_bytes + 2.0 * static_cast<double>(system.factor_bytes()));
  }
  plan.factorize_cost = std::numeric_limits<double>::infinity();
  if (!by_multigrid || system.model().num_nodes <= kMostAnalyzedNodes) {
    const CholeskyFactor tangent(system.pattern().blocks());
    const double bytes = static_cast<double>(tangent.bytes());
    plan.tangent_cost = streaming_cost(matrix_bytes + 2.0 * bytes);
    if (bytes <= kMaxFactorBytes)
      plan.factorize_cost = flop_cost(tangent.flops()) + 2.0 * streaming_cost(matrix_bytes);
  }
  plan.jacobi_cost = streaming_cost(matrix_bytes);
  const auto limit = [&](double cost) {
    return static_cast<int>(
        std::min<double>(kMaxProbe, std::max<double>(kLeastProbe, plan.factorize_cost / cost)));
  };
  const auto jacobi_limit = [&](int iterations) {
    const int most = limit(plan.jacobi_cost);
    if (!by_multigrid) return most;
    const double step = kSetupsPerStep * plan.setup_cost + iterations * plan.iteration_cost;
    return std::min(most, static_cast<int>(step / plan.jacobi_cost));
  };
  const Probe found =
      probe(system, inputs, preconditioner, limit(plan.iteration_cost), jacobi_limit, pool);
  plan.iterations = found.preconditioned;
  plan.contact_iterations = found.rotating;
  plan.jacobi_iterations = found.jacobi;
  return plan;
}

}  // namespace diffsim
