#include "kernels/soft/pressure.h"

#include <algorithm>

#include "kernels/subscript.h"

namespace diffsim {
namespace {

using Index = std::int64_t;
constexpr Index kNodesPerTask = 64;

struct Vec3 {
  double v[3];
};
Vec3 minus(const Vec3& a, const Vec3& b) {
  return {{a.v[0] - b.v[0], a.v[1] - b.v[1], a.v[2] - b.v[2]}};
}
Vec3 cross(const Vec3& a, const Vec3& b) {
  return {{a.v[1] * b.v[2] - a.v[2] * b.v[1], a.v[2] * b.v[0] - a.v[0] * b.v[2],
           a.v[0] * b.v[1] - a.v[1] * b.v[0]}};
}
double dot(const Vec3& a, const Vec3& b) {
  return a.v[0] * b.v[0] + a.v[1] * b.v[1] + a.v[2] * b.v[2];
}
void add(double scale, const Vec3& a, double* out) {
  for (int i = 0; i < 3; ++i) out[i] += scale * a.v[i];
}

/// Points of all chambers relative to one node of each: volumes do not change, and far from the
/// origin nothing cancels.
class Points {
 public:
  Points(const SoftModel& model, const double* x) : model_(model), x_(x) {
    const Chambers& all = model.chambers;
    for (Index c = 0; c < all.num_chambers; ++c)
      origin_.push_back(node(all.triangles[at(3 * all.start[at(c)])]));
    for (Index lid = 0; lid < all.num_lids; ++lid) {
      const Index first = all.lid_start[at(lid)], last = all.lid_start[at(lid + 1)];
      Vec3 mean{{0.0, 0.0, 0.0}};
      for (Index k = first; k < last; ++k)
        add(1.0 / static_cast<double>(last - first),
            (*this)(all.lid_chamber[at(lid)], all.lid_nodes[at(k)]), mean.v);
      center_.push_back(mean);
    }
  }
  Vec3 operator()(Index chamber, Index point) const {
    if (point >= model_.num_nodes) return center_[at(point - model_.num_nodes)];
    return minus(node(point), origin_[at(chamber)]);
  }
  /// The node after (step = 1) or before (-1) place k of a lid's rim.
  Vec3 rim(Index lid, Index place, Index step) const {
    const Chambers& all = model_.chambers;
    const Index first = all.lid_start[at(lid)], size = all.lid_start[at(lid + 1)] - first;
    return (*this)(all.lid_chamber[at(lid)],
                   all.lid_nodes[at(first + (place + step + size) % size)]);
  }

 private:
  Vec3 node(Index i) const { return {{x_[3 * i], x_[3 * i + 1], x_[3 * i + 2]}}; }
  const SoftModel& model_;
  const double* x_;
  std::vector<Vec3> origin_, center_;
};

bool absent(const SoftModel& model, const double* pressure) {
  const Index count = model.chambers.num_chambers;
  return pressure == nullptr ||
         std::all_of(pressure, pressure + count, [](double p) { return p == 0.0; });
}

/// Calls f(k) for all k in chambers.nodes.
template <typename F>
void for_chamber_nodes(const Chambers& all, ThreadPool& pool, F&& f) {
  const Index count = static_cast<Index>(all.nodes.size());
  pool.run((count + kNodesPerTask - 1) / kNodesPerTask, [&](Index task) {
    const Index last = std::min(count, (task + 1) * kNodesPerTask);
    for (Index k = task * kNodesPerTask; k < last; ++k) f(k);
  });
}

/// Adds scale [a]x, the matrix of a x ., to a block.
void add_skew(double scale, const Vec3& a, double* block) {
  const double x = scale * a.v[0], y = scale * a.v[1], z = scale * a.v[2];
  block[block3_place(0, 1)] -= z, block[block3_place(0, 2)] += y;
  block[block3_place(1, 0)] += z, block[block3_place(1, 2)] -= x;
  block[block3_place(2, 0)] -= y, block[block3_place(2, 1)] += x;
}

}  // namespace

double add_pressure_gradient(const SoftModel& model, const double* pressure, const double* x,
                             double* gradient, ThreadPool& pool) {
  if (absent(model, pressure)) return 0.0;
  const Chambers& all = model.chambers;
  const Points points(model, x);
  // d/dx_a of p/6 x_a . (x_b x x_c), and the same for the lids' centers.
  std::vector<Vec3> center(at(all.num_lids), Vec3{{0.0, 0.0, 0.0}});
  double energy = 0.0;
  for (Index c = 0; c < all.num_chambers; ++c)
    for (Index k = all.start[at(c)]; k < all.start[at(c + 1)]; ++k) {
      const Index* t = all.triangles.data() + 3 * k;
      const Vec3 area = cross(points(c, t[0]), points(c, t[1]));
      energy += pressure[c] / 6.0 * dot(area, points(c, t[2]));
      if (t[2] >= model.num_nodes)  // a lid: its triangles end at the center
        add(pressure[c] / 6.0, area, center[at(t[2] - model.num_nodes)].v);
    }
  for_chamber_nodes(all, pool, [&](Index k) {
    double* out = gradient + 3 * all.nodes[at(k)];
    for (Index i = all.corner_start[at(k)]; i < all.corner_start[at(k + 1)]; ++i) {
      const Chambers::Corner& corner = all.corners[at(i)];
      add(pressure[corner.chamber] / 6.0,
          cross(points(corner.chamber, corner.next), points(corner.chamber, corner.previous)), out);
    }
    for (Index i = all.rim_start[at(k)]; i < all.rim_start[at(k + 1)]; ++i) {
      const Chambers::RimCorner& rim = all.rims[at(i)];
      add(1.0 / static_cast<double>(rim.slots.size()), center[at(rim.lid)], out);
    }
  });
  return energy;
}

void add_pressure_tangent(const SoftModel& model, const double* pressure, const double* x,
                          double* values, ThreadPool& pool) {
  if (absent(model, pressure)) return;
  const Chambers& all = model.chambers;
  const Points points(model, x);
  for_chamber_nodes(all, pool, [&](Index k) {
    double* row = values + kBlock3 * model.row_start[at(all.nodes[at(k)])];
    // d(x_b x x_c) = -[x_c]x dx_b + [x_b]x dx_c
    for (Index i = all.corner_start[at(k)]; i < all.corner_start[at(k + 1)]; ++i) {
      const Chambers::Corner& corner = all.corners[at(i)];
      const double scale = pressure[corner.chamber] / 6.0;
      if (corner.slot_next >= 0)
        add_skew(-scale, points(corner.chamber, corner.previous), row + kBlock3 * corner.slot_next);
      if (corner.slot_previous >= 0)
        add_skew(scale, points(corner.chamber, corner.next), row + kBlock3 * corner.slot_previous);
    }
    // Through the lid's center, the mean of n nodes: d^2E/(dx_i dcenter) = p/6 [d_i]x with
    // d_i = x_next - x_previous, so nodes i, j of the rim share p/(6 n) [d_i - d_j]x.
    for (Index i = all.rim_start[at(k)]; i < all.rim_start[at(k + 1)]; ++i) {
      const Chambers::RimCorner& rim = all.rims[at(i)];
      const Index size = static_cast<Index>(rim.slots.size());
      const double scale =
          pressure[all.lid_chamber[at(rim.lid)]] / (6.0 * static_cast<double>(size));
      const Vec3 own = minus(points.rim(rim.lid, rim.place, 1), points.rim(rim.lid, rim.place, -1));
      for (Index j = 0; j < size; ++j) {
        const Vec3 other = minus(points.rim(rim.lid, j, 1), points.rim(rim.lid, j, -1));
        add_skew(scale, minus(own, other), row + kBlock3 * rim.slots[at(j)]);
      }
    }
  });
}

void pressure_adjoint(const SoftModel& model, const double* x, const double* z, double* out,
                      ThreadPool& pool) {
  const Chambers& all = model.chambers;
  if (out == nullptr || all.num_chambers == 0) return;
  const Points points(model, x), along(model, z);  // z as if positions: shifts cancel there too
  pool.run(all.num_chambers, [&](Index c) {
    double total = 0.0;
    for (Index k = all.start[at(c)]; k < all.start[at(c + 1)]; ++k)
      for (int a = 0; a < 3; ++a) {
        const Index* t = all.triangles.data() + 3 * k;
        total += dot(along(c, t[a]), cross(points(c, t[(a + 1) % 3]), points(c, t[(a + 2) % 3])));
      }
    out[c] = total / 6.0;
  });
}

void linearized_pressure_adjoint(const SoftModel& model, const double* pressure, const double* x,
                                 const double* d, const double* z, double* force, double* out,
                                 ThreadPool& pool) {
  const std::size_t count = static_cast<std::size_t>(model.chambers.num_chambers);
  if (!count) return;
  // The gradient G is a homogeneous quadratic form of positions, so that polarization is exact:
  // its second derivative along z and d is G(z + d) - G(z) - G(d), and G(x) + H d is
  // G(x + d) - G(d).
  const std::size_t size = static_cast<std::size_t>(3 * model.num_nodes);
  double most_z = 0.0, most_d = 0.0;
  for (std::size_t i = 0; i < size; ++i) {
    most_z = std::max(most_z, std::abs(z[i]));
    most_d = std::max(most_d, std::abs(d[i]));
  }
  // Of one size, so that the difference keeps its digits.
  const double scale = most_z > 0.0 && most_d > 0.0 ? most_d / most_z : 1.0;
  std::vector<double> z_scaled(size), both(size), end(size), gradient(size);
  for (std::size_t i = 0; i < size; ++i) {
    z_scaled[i] = scale * z[i];
    both[i] = z_scaled[i] + d[i];
    end[i] = x[i] + d[i];
  }
  const auto add = [&](double factor, const double* at) {
    std::fill(gradient.begin(), gradient.end(), 0.0);
    add_pressure_gradient(model, pressure, at, gradient.data(), pool);
    for (std::size_t i = 0; i < size; ++i) force[i] += factor / scale * gradient[i];
  };
  add(1.0, both.data());
  add(-1.0, z_scaled.data());
  add(-1.0, d);
  if (!out) return;
  std::vector<double> rest(count);
  pressure_adjoint(model, end.data(), z, out, pool);
  pressure_adjoint(model, d, z, rest.data(), pool);
  for (std::size_t k = 0; k < count; ++k) out[k] -= rest[k];
}

void add_linearized_pressure(const SoftModel& model, const double* pressure, const double* x,
                             const double* d, double* force, ThreadPool& pool) {
  // G(x + d) - G(d), as above.
  const std::size_t size = static_cast<std::size_t>(3 * model.num_nodes);
  std::vector<double> end(size), taken(size, 0.0);
  for (std::size_t i = 0; i < size; ++i) end[i] = x[i] + d[i];
  add_pressure_gradient(model, pressure, end.data(), force, pool);
  add_pressure_gradient(model, pressure, d, taken.data(), pool);
  for (std::size_t i = 0; i < size; ++i) force[i] -= taken[i];
}

}  // namespace diffsim
