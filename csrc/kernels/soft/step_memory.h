// The large arrays of a step, handed from one step to the next.
//
// The system clears fresh pages when they are first written, which takes a fifth of a step of a
// large body. Only memory is handed on, and singular values of positions that are equal bit by bit
// (an adjoint begins where its step ended): the bits of a step do not depend on what ran before.
#pragma once

#include <memory>
#include <mutex>
#include <vector>

#include "kernels/linalg/rigid_multigrid.h"
#include "kernels/soft/elasticity.h"

namespace diffsim {

struct StepMemory {
  AlignedBuffer<double> values;  // the tangent
  ElasticityScratch elastic;
  std::unique_ptr<RigidMultigrid> multigrid;  // none where no step has used one
};

/// Memories that nobody uses at the moment; as many as were used at the same time.
template <typename Memory>
class IdleMemories {
 public:
  std::unique_ptr<Memory> take() {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (idle_.empty()) return std::make_unique<Memory>();
    std::unique_ptr<Memory> memory = std::move(idle_.back());
    idle_.pop_back();
    return memory;
  }
  void give_back(std::unique_ptr<Memory> memory) {
    const std::lock_guard<std::mutex> lock(mutex_);
    idle_.push_back(std::move(memory));
  }

 private:
  std::mutex mutex_;
  std::vector<std::unique_ptr<Memory>> idle_;
};

/// Memories of steps, which remember nothing of the one before.
class StepMemories {
 public:
  std::unique_ptr<StepMemory> take() {
    std::unique_ptr<StepMemory> memory = idle_.take();
    if (memory->multigrid) memory->multigrid->forget();
    memory->elastic.kept_at.clear();
    return memory;
  }
  void give_back(std::unique_ptr<StepMemory> memory) { idle_.give_back(std::move(memory)); }

 private:
  IdleMemories<StepMemory> idle_;
};

}  // namespace diffsim
