#include "kernels/soft/contact/contact_preconditioner.h"

#include <Eigen/Cholesky>
#include <cmath>
#include <limits>

#include "kernels/subscript.h"

namespace diffsim {

struct ContactPreconditioner::Factor {
  Eigen::LLT<Eigen::MatrixXd> llt;
};

namespace {

// Columns of A^-1 above this are not worth their memory.
constexpr double kMaxColumnBytes = 1.5e9;
// Contact sets that a step meets on average before its own is found.
constexpr double kSetsPerStep = 2.0;
// Rows that a slipping contact takes on average: its normal, and half the time across the slip.
constexpr double kRowsOfSlip = 1.5;
// Friction's resistance to a change of the slip's direction counts from here on, of the node's
// diagonal entry of A.
constexpr double kLeastSlipStiffness = 0.1;
// Normals lie along an axis up to rounding.
constexpr double kAligned = 1.0 - 1e-14;
// Seconds that multigrid takes of those modeled, in contact and beside a factor of the tangent:
// 0.60 s of 50 adjoints of a ball of 8,280 DoF where the factor takes 0.55 (Zen 5, AVX2).
constexpr double kCycleOverhead = 1.4;
// A solve streams the factor forwards and backwards.
constexpr double kFactorStreams = 2.0;
// Stiffness across the slip, of the node's diagonal entry of A, above which single precision loses
// what the node has beside it: of 1e6 a tenth would be left.
constexpr double kFloatStiffness = 1e3;

/// Axis that a unit vector lies along, or -1.
int aligned_axis(const double* n) {
  for (int a = 0; a < 3; ++a)
    if (std::abs(n[a]) > kAligned) return a;
  return -1;
}

// Entries of columns that are summed at once, in the nearest cache.
constexpr std::int64_t kStrip = 1024;

struct WeightedColumn {
  const double* column;
  double weight;
};

/// Adds rows [begin, begin + size) of weighted columns to a strip, four columns in a pass over it.
void add_columns(const std::vector<WeightedColumn>& columns, std::int64_t begin, std::int64_t size,
                 double* __restrict strip) {
  constexpr std::size_t kTogether = 4;
  std::size_t i = 0;
  for (; i + kTogether <= columns.size(); i += kTogether) {
    const WeightedColumn* c = &columns[i];
    const double *c0 = c[0].column + begin, *c1 = c[1].column + begin;
    const double *c2 = c[2].column + begin, *c3 = c[3].column + begin;
    const double w0 = c[0].weight, w1 = c[1].weight, w2 = c[2].weight, w3 = c[3].weight;
    for (std::int64_t j = 0; j < size; ++j)
      strip[j] += (c0[j] * w0 + c1[j] * w1) + (c2[j] * w2 + c3[j] * w3);
  }
  for (; i < columns.size(); ++i) {
    const double* c0 = columns[i].column + begin;
    const double w0 = columns[i].weight;
    for (std::int64_t j = 0; j < size; ++j) strip[j] += c0[j] * w0;
  }
}

}  // namespace

void ContactPreconditioner::make_rows() {
  active_.clear();
  active_contact_.clear();
  groups_.clear();
  bool aligned = true, all_stick = true;
  for (std::size_t k = 0; k < space_.size(); ++k) {
    if (space_.status[k] == ContactStatus::kSeparate) continue;
    active_.push_back(space_.inputs().node[k]);
    active_contact_.push_back(k);
    if (space_.status[k] == ContactStatus::kStick) continue;
    all_stick = false;
    aligned = aligned && aligned_axis(space_.normal(k)) >= 0 && space_.slip_stiffness[k] == 0.0;
  }
  if (active_.empty()) return;
  groups_.resize(aligned && !all_stick ? 3 : 1);
  if (all_stick && system_.num_factors() == 1) groups_[0].axes = 3;
  if (all_stick && system_.num_factors() > 1) groups_.resize(3);
  for (std::size_t i = 0; i < active_.size(); ++i) {
    const std::size_t k = active_contact_[i];
    const double* n = space_.normal(k);
    if (space_.status[k] == ContactStatus::kStick) {
      for (int a = 0; a < (groups_[0].axes == 3 ? 1 : 3); ++a) {
        Row row{i, {0.0, 0.0, 0.0}, 0.0};
        row.direction[a] = 1.0;
        groups_[groups_.size() == 3 ? at(a) : 0].rows.push_back(row);
      }
      continue;
    }
    const std::size_t group = groups_.size() == 3 ? at(aligned_axis(n)) : 0;
    groups_[group].rows.push_back({i, {n[0], n[1], n[2]}, 0.0});
    const double stiffness = space_.slip_stiffness[k];
    if (stiffness > kLeastSlipStiffness * system_.diagonal()[active_[i]]) {
      Row row{i, {}, 1.0 / stiffness};
      space_.across_slip(k, row.direction);
      groups_[group].rows.push_back(row);
    }
  }
}

double ContactPreconditioner::inverse_entry(std::size_t i, std::size_t j, int axis) const {
  return columns_->column(active_[i], axis)[active_[j]];
}

void ContactPreconditioner::factorize_group(Group& group) {
  const Eigen::Index size = static_cast<Eigen::Index>(group.rows.size());
  Eigen::MatrixXd S(size, size);
  pool_.run(size, [&](std::int64_t j) {
    const Row& b = group.rows[at(j)];
    for (Eigen::Index i = j; i < size; ++i) {
      const Row& a = group.rows[at(i)];
      double total = 0.0;
      for (int axis = 0; axis < 3; ++axis) {
        const double both = a.direction[axis] * b.direction[axis];
        if (both != 0.0) total += both * inverse_entry(b.active, a.active, axis);
      }
      S(i, j) = total + (i == j ? a.compliance : 0.0);
    }
  });
  group.factor = std::make_shared<const Factor>(Factor{Eigen::LLT<Eigen::MatrixXd>(S)});
}

void ContactPreconditioner::prepare_base() {
  kind_ = Kind::kBase;
  if (problem_.by_multigrid()) {
    problem_.hold_nodes(without_stiff_slips());
    return;
  }
  prepare_columns();
  rotations_.prepare(problem_, system_, problem_.assembled_at(),
                     [this](Vector& v) { hold(nullptr, v); });
}

std::vector<HeldNode> ContactPreconditioner::without_stiff_slips() {
  std::vector<HeldNode> held;
  stiff_slips_.clear();
  for (std::size_t k = 0; k < space_.size(); ++k) {
    if (space_.status[k] == ContactStatus::kSeparate) continue;
    const std::int64_t node = space_.inputs().node[k];
    const double stiffness = space_.slip_stiffness[k];
    const bool on_rail = space_.on_rail(k);
    const bool stiff = space_.status[k] == ContactStatus::kSlip && !on_rail &&
                       stiffness > kFloatStiffness * system_.diagonal()[node];
    held.push_back(space_.held_node(k, on_rail || stiff));
    if (!stiff) continue;
    StiffSlip slip{node, {}, 1.0 / stiffness};
    space_.across_slip(k, slip.across);
    stiff_slips_.push_back(slip);
  }
  return held;
}

void ContactPreconditioner::add_stiff_slips(const Vector& r, Vector& z) const {
  for (const StiffSlip& slip : stiff_slips_) {
    const std::size_t first = at(3 * slip.node);
    double along = 0.0;
    for (std::size_t i = 0; i < 3; ++i) along += slip.across[i] * r[first + i];
    for (std::size_t i = 0; i < 3; ++i) z[first + i] += slip.compliance * along * slip.across[i];
  }
}

void ContactPreconditioner::prepare_columns() {
  make_rows();
  if (active_.empty()) return;
  columns_ = &system_.inverse_columns();
  if (!cache_columns_) {
    own_columns_ = std::make_unique<InverseColumns>(system_);
    columns_ = own_columns_.get();
  }
  columns_->require(active_, pool_);
  for (Group& group : groups_)
    if (!group.rows.empty()) factorize_group(group);
}

bool ContactPreconditioner::prepare_tangent() {
  const SoftModel& model = system_.model();
  const std::vector<HeldNode> held = space_.held_nodes();
  std::vector<const HeldNode*> of_node(at(model.num_nodes), nullptr);
  for (const HeldNode& h : held) of_node[at(h.node)] = &h;
  using Block = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;
  const auto edit = [&](double* blocks) {
    constexpr std::int64_t kRows = 64;  // of a task
    pool_.run((model.num_nodes + kRows - 1) / kRows, [&](std::int64_t task) {
      const std::int64_t end = std::min(model.num_nodes, kRows * (task + 1));
      for (std::int64_t row = kRows * task; row < end; ++row)
        for (std::int64_t e = model.row_start[at(row)]; e < model.row_start[at(row + 1)]; ++e) {
          const HeldNode* left = of_node[at(row)];
          const HeldNode* right = of_node[at(model.column[at(e)])];
          if (!left && !right) continue;
          Eigen::Map<Block> B(blocks + 9 * e);
          const double diagonal = B.diagonal().cwiseAbs().maxCoeff();
          if (left) B = (Eigen::Map<const Block>(left->free) * B).eval();
          if (right) B = (B * Eigen::Map<const Block>(right->free)).eval();
          if (model.column[at(e)] == row)
            B += diagonal * (Block::Identity() - Eigen::Map<const Block>(left->free)) +
                 Eigen::Map<const Block>(left->stiffness);
        }
    });
  };
  kind_ = problem_.factorize_roughly(edit) ? Kind::kTangent : Kind::kBase;
  return kind_ == Kind::kTangent;
}

void ContactPreconditioner::subtract_columns(Vector& z) const {
  std::vector<WeightedColumn> columns[3];  // of each axis; most multipliers of a slip are zero
  for (int a = 0; a < 3; ++a)
    for (std::size_t i = 0; i < active_.size(); ++i)
      if (const double f = multiplier_[3 * i + at(a)]; f != 0.0)
        columns[a].push_back({columns_->column(active_[i], a), f});
  pool_.run_ranges(system_.model().num_nodes, kStrip, [&](std::int64_t begin, std::int64_t end) {
    double strip[kStrip];
    for (int a = 0; a < 3; ++a) {
      if (columns[a].empty()) continue;
      const std::int64_t size = end - begin;
      std::fill_n(strip, size, 0.0);
      add_columns(columns[a], begin, size, strip);
      for (std::int64_t j = 0; j < size; ++j) z[at(3 * (begin + j) + a)] -= strip[j];
    }
  });
}

void ContactPreconditioner::apply(const Vector& r, Vector& z) {
  if (on_tangent() || problem_.by_multigrid()) {
    on_tangent() ? problem_.solve_factorized(r, z) : problem_.precondition(r, z);
    space_.project(z);
    if (!on_tangent()) add_stiff_slips(r, z);
    return;
  }
  problem_.solve_constant(r, z);
  hold(&r, z);
  rotations_.add(r, z, problem_.ops());
}

void ContactPreconditioner::hold(const Vector* r, Vector& z) {
  if (active_.empty()) return;
  multiplier_.assign(3 * active_.size(), 0.0);
  for (Group& group : groups_) {
    const Eigen::Index size = static_cast<Eigen::Index>(group.rows.size());
    if (size == 0) continue;
    Eigen::MatrixXd l(size, group.axes);
    for (Eigen::Index j = 0; j < size; ++j) {
      const Row& row = group.rows[at(j)];
      const double* at_node = z.data() + 3 * at(active_[row.active]);
      if (group.axes == 3)
        for (int a = 0; a < 3; ++a) l(j, a) = at_node[a];
      else
        l(j, 0) = row.direction[0] * at_node[0] + row.direction[1] * at_node[1] +
                  row.direction[2] * at_node[2];
    }
    group.factor->llt.solveInPlace(l);
    for (Eigen::Index j = 0; j < size; ++j) {
      const Row& row = group.rows[at(j)];
      for (std::size_t a = 0; a < 3; ++a)
        multiplier_[3 * row.active + a] +=
            group.axes == 3 ? l(j, static_cast<Eigen::Index>(a)) : l(j, 0) * row.direction[a];
    }
  }
  const double by_columns =
      8.0 * static_cast<double>(system_.model().num_nodes) * static_cast<double>(active_.size());
  if (!r || by_columns < kFactorStreams * static_cast<double>(system_.factor_bytes())) {
    subtract_columns(z);
  } else {
    second_ = *r;
    for (std::size_t i = 0; i < active_.size(); ++i)
      for (std::size_t a = 0; a < 3; ++a) second_[3 * at(active_[i]) + a] -= multiplier_[3 * i + a];
    problem_.solve_constant(second_, z);
  }
  space_.project(z);  // rounding
}

double ContactPreconditioner::base_cost(double setups, double iterations) const {
  const SolverPlan& plan = system_.plan();
  return problem_.by_multigrid()
             ? kCycleOverhead * (setups * plan.setup_cost + iterations * plan.iteration_cost)
             : constant_cost(iterations);
}

double ContactPreconditioner::constant_cost(double iterations) const {
  double active = 0.0, rows = 0.0;
  bool coupled = false;
  for (std::size_t k = 0; k < space_.size(); ++k) {
    if (space_.status[k] == ContactStatus::kSeparate) continue;
    active += 1.0;
    rows += space_.status[k] == ContactStatus::kStick ? 3.0 : kRowsOfSlip;
    coupled = coupled || space_.status[k] == ContactStatus::kSlip;
  }
  const double column_bytes = 8.0 * static_cast<double>(system_.model().num_nodes) * active;
  if (column_bytes > kMaxColumnBytes) return std::numeric_limits<double>::infinity();
  const double size = coupled ? rows : active;
  const double build = flop_cost(size * size * size / 3.0);
  const double apply = flop_cost(2.0 * size * size * (coupled ? 1.0 : 3.0)) +
                       std::min(streaming_cost(column_bytes), system_.plan().iteration_cost);
  return kSetsPerStep * build + iterations * (system_.plan().iteration_cost + apply);
}

double ContactPreconditioner::tangent_cost() const {
  return kSetsPerStep * system_.plan().factorize_cost +
         kTangentIterations * system_.plan().tangent_cost;
}

}  // namespace diffsim
