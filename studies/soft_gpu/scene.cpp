#include "scene.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <memory>
#include <random>

#include "kernels/linalg/rigid_hierarchy.h"
#include "kernels/soft/implicit_step.h"
#include "kernels/soft/linear_step.h"
#include "kernels/soft/material.h"

namespace study {
namespace {

constexpr double kLength = 0.32, kWidth = 0.08, kDensity = 1e3, kDt = 1e-2;
constexpr double kYoung = 1e6, kPoisson = 0.45;

Pattern plain(const diffsim::Pattern& p) {
  Pattern out;
  out.start.assign(p.row_start.begin(), p.row_start.end());
  out.column.assign(p.column.begin(), p.column.end());
  return out;
}

std::vector<double> shape_gradients(const double size[3], Scene& scene) {
  const double point = 1.0 / std::sqrt(3.0);
  for (int q = 0; q < 8; ++q) {
    scene.weight[q] = size[0] * size[1] * size[2] / 8.0;
    for (int a = 0; a < 8; ++a)
      for (int i = 0; i < 3; ++i) {
        double value = (a >> i & 1 ? 2.0 : -2.0) / size[i] / 2.0;
        for (int k = 0; k < 3; ++k)
          if (k != i)
            value *= 0.5 * (1.0 + (a >> k & 1 ? 1.0 : -1.0) * (q >> k & 1 ? point : -point));
        scene.grad[q][a][i] = value;
      }
  }
  return {&scene.grad[0][0][0], &scene.grad[0][0][0] + 192};
}

std::shared_ptr<const diffsim::SoftPattern> pattern_of(const Scene& s) {
  std::vector<std::int64_t> elements(s.elements.begin(), s.elements.end());
  std::vector<std::int64_t> kinds(static_cast<std::size_t>(s.num_elements), 0);
  diffsim::MeshTables t;
  t.material = diffsim::find_material("pd");
  t.num_nodes = s.num_nodes, t.num_elements = s.num_elements, t.num_classes = 1;
  t.elements = elements.data(), t.class_idx = kinds.data();
  t.grad = &s.grad[0][0][0], t.weight = s.weight, t.coords = s.rest.data();
  return std::make_shared<diffsim::SoftPattern>(diffsim::make_soft_model(t), s.rest.data());
}

double seconds_of(auto&& call) {
  const auto began = std::chrono::steady_clock::now();
  call();
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - began).count();
}

double median(std::vector<double> values) {
  std::nth_element(values.begin(), values.begin() + values.size() / 2, values.end());
  return values[values.size() / 2];
}

void place_nodes(const int cells[3], double degrees, Scene& s) {
  const double size[3] = {kLength / cells[0], kWidth / cells[1], kWidth / cells[2]};
  const double turn = degrees * std::acos(-1.0) / 180.0;
  const int n[3] = {cells[0] + 1, cells[1] + 1, cells[2] + 1};
  for (int i = 0; i < n[0]; ++i)
    for (int j = 0; j < n[1]; ++j)
      for (int k = 0; k < n[2]; ++k) {
        const double x = i * size[0], y = j * size[1] - kWidth / 2, z = k * size[2] - kWidth / 2;
        const double c = std::cos(turn * x / kLength), d = std::sin(turn * x / kLength);
        for (double v : {x, y, z}) s.rest.push_back(v);
        for (double v : {x, y * c - z * d, y * d + z * c}) s.start.push_back(v);
        for (int axis = 0; axis < 3; ++axis) s.fixed.push_back(i == 0);
      }
  s.num_nodes = n[0] * n[1] * n[2];
  s.inertia.assign(static_cast<std::size_t>(s.num_nodes), 0.0);
  const double share = kDensity * size[0] * size[1] * size[2] / 8.0 / (kDt * kDt);
  for (int i = 0; i < cells[0]; ++i)
    for (int j = 0; j < cells[1]; ++j)
      for (int k = 0; k < cells[2]; ++k)
        for (int a = 0; a < 8; ++a) {
          const int node = ((i + (a & 1)) * n[1] + j + (a >> 1 & 1)) * n[2] + k + (a >> 2 & 1);
          s.elements.push_back(node);
          s.inertia[static_cast<std::size_t>(node)] += share;
        }
  s.num_elements = cells[0] * cells[1] * cells[2];
}

}  // namespace

Scene make_scene(const int cells[3], double degrees) {
  Scene s;
  place_nodes(cells, degrees, s);
  const double size[3] = {kLength / cells[0], kWidth / cells[1], kWidth / cells[2]};
  shape_gradients(size, s);
  s.w_mu = kYoung / (1.0 + kPoisson);
  s.w_vol = kYoung * kPoisson / ((1.0 + kPoisson) * (1.0 - 2.0 * kPoisson));
  const auto pattern = pattern_of(s);
  const auto hierarchy = pattern->hierarchy();
  for (int l = 0; l < hierarchy->num_levels(); ++l) {
    s.levels.push_back(plain(hierarchy->matrix(l)));
    if (l + 1 == hierarchy->num_levels()) break;
    const diffsim::RigidTransfer& from = hierarchy->transfer(l);
    Transfer t;
    t.aggregate = from.aggregates.of_node;
    t.num_aggregates = static_cast<int>(from.aggregates.count);
    t.prolongation = plain(from.prolongation);
    t.product = plain(from.product);
    t.restriction = plain(from.restriction);
    t.restriction_entry.assign(from.restriction_entry.begin(), from.restriction_entry.end());
    s.transfers.push_back(std::move(t));
  }
  return s;
}

std::vector<double> loss_gradient(const Scene& scene) {
  std::mt19937_64 random(0);
  std::normal_distribution<double> normal;
  std::vector<double> out(scene.start.size());
  for (double& v : out) v = normal(random);
  return out;
}

/// What a step on the CPU reads and writes.
struct Cpu {
  explicit Cpu(const Scene& s, const std::vector<double>& starts, int threads)
      : members(starts.size() / s.start.size()),
        weights(2 * at(s.num_elements), s.w_mu),
        force(starts.size(), 0.0),
        fibers(3 * at(s.num_elements), 0.0) {
    using namespace diffsim;
    const std::size_t elements = at(s.num_elements);
    std::fill(weights.begin() + s.num_elements, weights.end(), s.w_vol);
    const std::vector<double> kappa(elements, s.w_mu + 0.1 * s.w_vol);
    ConstantSystemInputs given;
    given.fixed = s.fixed.data(), given.inertia = s.inertia.data(), given.kappa = kappa.data();
    given.fiber_kappa = fibers.data(), given.parameters.weights = weights.data();
    ThreadPool pool(threads);
    system = std::make_unique<ConstantSystem>(pattern_of(s), given, pool);
    in.parameters = given.parameters;
    in.y = in.target = in.guess = starts.data(), in.force = force.data();
    options.rtol = s.rtol;
    for (std::vector<double>* v : {&answer.x, &answer.z, &target, &rest, &guess})
      v->resize(starts.size());
    inertia.resize(members * s.inertia.size()), weight.resize(members * weights.size());
    out.y = rest.data(), out.force = answer.z.data(), out.target = target.data();
    out.guess = guess.data(), out.inertia = inertia.data();
    out.parameters.weights = weight.data();
    const std::vector<double> one = loss_gradient(s);
    for (std::size_t k = 0; k < members; ++k) loss.insert(loss.end(), one.begin(), one.end());
    stats.resize(members), adjoint.resize(members);
  }
  static std::size_t at(int k) { return static_cast<std::size_t>(k); }

  Answer run(int threads, int repeats) {
    std::vector<double> forward, backward;
    const auto batch = static_cast<std::int64_t>(members);
    for (int k = 0; k <= repeats; ++k) {
      forward.push_back(seconds_of([&] {
        implicit_step_batch(*system, in, options, batch, answer.x.data(), stats.data(), threads);
      }));
      backward.push_back(seconds_of([&] {
        implicit_step_adjoint_batch(*system, in, options, batch, answer.x.data(), loss.data(), out,
                                    adjoint.data(), threads);
      }));
    }
    forward.erase(forward.begin()), backward.erase(backward.begin());
    answer.step_s = median(forward), answer.adjoint_s = median(backward);
    answer.residual = stats[0].residual_norm, answer.tolerance = stats[0].tolerance;
    answer.newton = stats[0].num_iters, answer.cycles = stats[0].num_solves;
    answer.adjoint_cycles = adjoint[0].num_iters;
    return answer;
  }

  std::size_t members;
  std::vector<double> weights, force, fibers, loss, rest, target, guess, inertia, weight;
  std::unique_ptr<diffsim::ConstantSystem> system;
  diffsim::StepInputs in;
  diffsim::StepOptions options;
  diffsim::StepAdjoint out;
  std::vector<diffsim::StepStats> stats, adjoint;
  Answer answer;
};

Answer step_on_cpu(const Scene& s, int threads, int repeats) {
  return Cpu(s, s.start, threads).run(threads, repeats);
}

Answer batch_on_cpu(const Scene& s, const std::vector<double>& starts, int threads, int repeats) {
  Cpu cpu(s, starts, threads);
  cpu.options.method = diffsim::StepMethod::kLinearlyImplicit;
  return cpu.run(threads, repeats);
}

}  // namespace study
