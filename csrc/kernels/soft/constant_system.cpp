#include "kernels/soft/constant_system.h"

#include <limits>

#include "kernels/linalg/cholesky_symbolic.h"
#include "kernels/soft/hourglass.h"
#include "kernels/subscript.h"

namespace diffsim {
namespace {

using Index = std::int64_t;

/// Adds kappa_e grad_a . grad_b [N/m] of the samples of group g; `direction` restricts to a fiber.
template <typename Group>
void add_group(const SoftModel& model, const ElementBlock& block,
               const std::vector<std::int32_t>& slots, Index g, const double* kappa,
               const double* direction, Vector& values) {
  constexpr int n = Group::kNodes;
  constexpr int per_group = Group::kInLanes ? kLanes : 1;
  const auto& shape = Group::shape(block, g);
  const Lane weight = shape.weight * Group::element_value(block, g, kappa);
  Lane along[n];
  Lane modes[8][8];
  if constexpr (std::is_same_v<Group, MeanHexGroup>)
    hourglass::scalar_matrix(block.hourglass[at(block.mean_class[at(g)])], modes);
  if (direction) {
    for (int a = 0; a < n; ++a) {
      along[a] = broadcast(0.0);
      for (int i = 0; i < 3; ++i)
        along[a] += Group::element_value(block, g, direction, 3, i) * shape.grad[a][i];
    }
  }
  for (int a = 0; a < n; ++a)
    for (int b = 0; b < n; ++b) {
      const Lane product = direction ? along[a] * along[b]
                                     : shape.grad[a][0] * shape.grad[b][0] +
                                           shape.grad[a][1] * shape.grad[b][1] +
                                           shape.grad[a][2] * shape.grad[b][2];
      Lane k = weight * product;
      if constexpr (std::is_same_v<Group, MeanHexGroup>)
        if (!direction) k += modes[a][b] * Group::element_value(block, g, kappa);
      for (int lane = 0; lane < per_group; ++lane) {
        const Index e = g * per_group + lane;
        if (e >= block.num_elements) break;
        const Index row = block.nodes[at(e * n + a)];
        values[at(model.row_start[at(row)] + slots[at((e * n + a) * n + b)])] +=
            per_group == 1 ? sum(k) : k[lane];
      }
    }
}

Vector scalar_matrix(const SoftModel& model, const ConstantSystemInputs& in) {
  Vector values(model.column.size(), 0.0);
  const auto add = [&](auto group) {
    using Group = decltype(group);
    for (Index g = 0; g < model.solid.num_groups; ++g)
      add_group<Group>(model, model.solid, model.solid_slot, g, in.kappa, nullptr, values);
    for (Index g = 0; g < model.fiber.num_groups; ++g)
      add_group<Group>(model, model.fiber, model.fiber_slot, g, in.fiber_kappa,
                       model.fiber_directions.data(), values);
  };
  with_group(model.solid, add);
  for (Index i = 0; i < model.num_nodes; ++i) values[at(model.diagonal[at(i)])] += in.inertia[i];
  return values;
}

/// Rows and columns of fixed nodes become those of the identity times the mean diagonal.
Vector with_dirichlet(const SoftModel& model, Vector values, const std::uint8_t* fixed, int axis) {
  double scale = 0.0;
  for (Index d : model.diagonal) scale += values[at(d)];
  scale /= static_cast<double>(model.num_nodes);
  for (Index row = 0; row < model.num_nodes; ++row)
    for (Index k = model.row_start[at(row)]; k < model.row_start[at(row + 1)]; ++k) {
      const Index col = model.column[at(k)];
      if (fixed[3 * row + axis] || fixed[3 * col + axis]) values[at(k)] = row == col ? scale : 0.0;
    }
  return values;
}

// Bodies of more nodes, or more products of blocks in a factor, go by wide fronts.
constexpr Index kMostSmallNodes = 500, kMostSmallProducts = 100000;

// Multigrid that needs more iterations than this at rest is compared with the constant factor.
constexpr double kFewIterations = 12.0;
// In contact it is compared anyway, at this tolerance, on bodies whose constant matrix takes no
// longer to factorize than some steps.
constexpr std::int64_t kMostContactNodes = 20000;
constexpr double kUsualTolerance = 1e-4;

/// Throws where a part of the body has neither inertia nor a fixed node on some axis.
void require_held(const SoftModel& model, const ConstantSystemInputs& in) {
  std::vector<std::uint8_t> seen(at(model.num_nodes), 0);
  std::vector<Index> todo;
  for (Index first = 0; first < model.num_nodes; ++first) {
    if (seen[at(first)]) continue;
    bool held[3] = {false, false, false};
    seen[at(first)] = 1;
    todo.assign(1, first);
    while (!todo.empty()) {
      const Index i = todo.back();
      todo.pop_back();
      for (int axis = 0; axis < 3; ++axis)
        held[axis] = held[axis] || in.inertia[i] > 0.0 || in.fixed[3 * i + axis];
      for (Index k = model.row_start[at(i)]; k < model.row_start[at(i + 1)]; ++k) {
        const Index j = model.column[at(k)];
        if (!seen[at(j)]) todo.push_back(j);
        seen[at(j)] = 1;
      }
    }
    if (!held[0] || !held[1] || !held[2]) throw NotPositiveDefinite(first, 0.0);
  }
}

bool same_set(const SoftModel& model, const std::uint8_t* fixed, int a, int b) {
  for (Index i = 0; i < model.num_nodes; ++i)
    if (fixed[3 * i + a] != fixed[3 * i + b]) return false;
  return true;
}

/// The columns of the graph as Cholesky's analysis reads them.
std::vector<Index> wide_columns(const SoftModel& model) {
  return {model.column.begin(), model.column.end()};
}

}  // namespace

SoftPattern::SoftPattern(SoftModel model, const double* coords)
    : model_(std::move(model)), coords_(coords, coords + 3 * model_.num_nodes) {}

std::shared_ptr<const CholeskySymbolic> SoftPattern::scalar() const {
  std::call_once(scalar_once_, [this] {
    const std::vector<Index> columns = wide_columns(model_);
    scalar_ = analyze_cholesky(model_.num_nodes, model_.row_start.data(), columns.data(),
                               coords_.data(), 1);
  });
  return scalar_;
}

std::shared_ptr<const CholeskySymbolic> SoftPattern::blocks() const {
  std::call_once(blocks_once_, [this] {
    const std::vector<Index> columns = wide_columns(model_);
    blocks_ = analyze_cholesky(model_.num_nodes, model_.row_start.data(), columns.data(),
                               coords_.data(), 3);
  });
  return blocks_;
}

std::shared_ptr<const RigidHierarchy> SoftPattern::hierarchy() const {
  std::call_once(hierarchy_once_, [this] {
    Pattern nodes;
    nodes.row_start = model_.row_start;
    nodes.column = model_.column;
    hierarchy_ = std::make_shared<const RigidHierarchy>(std::move(nodes));
  });
  return hierarchy_;
}

const SmallTables* SoftPattern::small() const {
  std::call_once(small_once_, [this] {
    if (model_.num_nodes > kMostSmallNodes || model_.chambers.num_chambers > 0) return;
    SmallPattern pattern(model_.row_start, model_.column);
    if (pattern.num_products() > kMostSmallProducts) return;
    SmallPlaces places = small_places(model_, pattern);
    small_.reset(new SmallTables{std::move(pattern), std::move(places)});
  });
  return small_.get();
}

ConstantSystem::ConstantSystem(std::shared_ptr<const SoftPattern> pattern,
                               const ConstantSystemInputs& inputs, ThreadPool& pool)
    : pattern_(std::move(pattern)),
      fixed_(inputs.fixed, inputs.fixed + 3 * model().num_nodes),
      inertia_(inputs.inertia, inputs.inertia + model().num_nodes),
      inverse_columns_(*this) {
  const Vector values = scalar_matrix(model(), inputs);
  for (Index d : model().diagonal) diagonal_.push_back(values[at(d)]);
  require_held(model(), inputs);
  const bool tries_multigrid =
      inputs.preconditioner == Preconditioner::kMultigrid ||
      (inputs.preconditioner == Preconditioner::kAuto && suits_multigrid(model()));
  if (tries_multigrid) {
    plan_ = make_solver_plan(*this, inputs, Preconditioner::kMultigrid, pool);
    const bool suffices = plan_.iterations <= kFewIterations &&
                          !(inputs.in_contact && model().num_nodes <= kMostContactNodes);
    if (inputs.preconditioner == Preconditioner::kMultigrid || suffices) return;
  }
  factorize(values, pool);
  const SolverPlan constant = make_solver_plan(*this, inputs, Preconditioner::kConstant, pool);
  const auto cost = [&](const SolverPlan& plan) {
    return inputs.in_contact ? plan.contact_cost(kUsualTolerance)
                             : plan.iterations * plan.iteration_cost;
  };
  if (tries_multigrid && cost(plan_) < cost(constant))
    factors_.clear();
  else
    plan_ = constant;
}

void ConstantSystem::factorize(const Vector& values, ThreadPool& pool) {
  for (int axis = 0; axis < 3; ++axis) {
    bool shared = false;
    for (AxisFactor& f : factors_)
      if (!shared && same_set(model(), fixed(), f.axes[0], axis)) {
        f.axes.push_back(axis);
        shared = true;
      }
    if (shared) continue;
    factors_.push_back({{axis}, CholeskyFactor(pattern_->scalar())});
    factors_.back().factor.refactor(with_dirichlet(model(), values, fixed(), axis).data(), pool);
  }
}

std::int64_t ConstantSystem::factor_bytes() const {
  std::int64_t bytes = 0;
  for (const AxisFactor& f : factors_) bytes += f.factor.bytes();
  return bytes;
}

double ConstantSystem::rounding_floor(const Vector& x) const {
  double total = 0.0;
  for (std::size_t i = 0; i < x.size(); ++i) {
    const double f = diagonal_[i / 3] * x[i];
    total += f * f;
  }
  return 2.0 * std::numeric_limits<double>::epsilon() * std::sqrt(total);
}

int ConstantSystem::factor_of_axis(int axis) const {
  for (std::size_t f = 0; f < factors_.size(); ++f)
    for (int a : factors_[f].axes)
      if (a == axis) return static_cast<int>(f);
  return 0;
}

void ConstantSystem::solve(const Vector& r, Vector& z, Scratch& scratch, ThreadPool& pool) const {
  z.resize(r.size());
  if (factors_.size() == 1) {
    factors_[0].factor.solve(r.data(), z.data(), 3, scratch.cholesky, pool);
    return;
  }
  for (const AxisFactor& f : factors_) {
    const std::size_t width = f.axes.size(), n = at(model().num_nodes);
    scratch.column.resize(n * width);
    for (std::size_t i = 0; i < n; ++i)
      for (std::size_t k = 0; k < width; ++k)
        scratch.column[i * width + k] = r[3 * i + static_cast<std::size_t>(f.axes[k])];
    f.factor.solve(scratch.column.data(), scratch.column.data(), static_cast<int>(width),
                   scratch.cholesky, pool);
    for (std::size_t i = 0; i < n; ++i)
      for (std::size_t k = 0; k < width; ++k)
        z[3 * i + static_cast<std::size_t>(f.axes[k])] = scratch.column[i * width + k];
  }
}

}  // namespace diffsim
