// Columns of A^-1, made when first asked for and kept: what contact on the constant factor needs.
#pragma once

#include <memory>
#include <mutex>
#include <vector>

#include "kernels/parallel.h"

namespace diffsim {

class ConstantSystem;

/// Grows behind a lock; columns never change or move once made.
class InverseColumns {
 public:
  explicit InverseColumns(const ConstantSystem& system) : system_(system) {}
  InverseColumns(const InverseColumns&) = delete;
  InverseColumns& operator=(const InverseColumns&) = delete;

  /// Makes the columns of these nodes on all axes; later calls for the same nodes cost nothing.
  void require(const std::vector<std::int64_t>& nodes, ThreadPool& pool);
  /// A^-1 e_node on one axis, (num_nodes,) [m/N]; `require` it first.
  const double* column(std::int64_t node, int axis) const;
  /// Forgets all columns; no other call may be running.
  void clear();

 private:
  const ConstantSystem& system_;
  std::mutex mutex_;
  std::vector<std::vector<std::unique_ptr<double[]>>> columns_;  // (factor, node)
};

}  // namespace diffsim
