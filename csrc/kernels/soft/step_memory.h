// The large arrays of a step, handed from one step to the next, and what is kept for its adjoint.
//
// The system clears fresh pages when they are first written, which takes a fifth of a step of a
// large body. Only memory is handed on, and singular values of positions that are equal bit by bit
// (an adjoint begins where its step ended): the bits of a step do not depend on what ran before.
#pragma once

#include <cstring>
#include <deque>
#include <memory>
#include <mutex>
#include <vector>

#include "kernels/linalg/cholesky.h"
#include "kernels/linalg/rigid_multigrid.h"
#include "kernels/linalg/small_cholesky.h"
#include "kernels/soft/elasticity.h"

namespace diffsim {

struct StepMemory {
  AlignedBuffer<double> values;  // the tangent
  ElasticityScratch elastic;
  std::unique_ptr<RigidMultigrid> multigrid;  // none where no step has used one
  CholeskyMemory factor;                      // of the tangent
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

/// What the step of a small body leaves to its adjoint.
struct KeptStep {
  std::vector<double> of;                 // all that the rest depends on
  std::unique_ptr<SmallCholesky> factor;  // the tangent and its factor
  AlignedBuffer<double> samples;          // as of ElasticityScratch
  std::vector<double> kept_at;
};

/// Steps whose adjoints may follow, oldest first. They are found again by what they depend on, bit
/// by bit, so that nothing hangs on who asks, and when.
class KeptSteps {
 public:
  /// @param most  steps that may be kept; older ones are forgotten
  void keep(KeptStep step, std::size_t most) {
    const std::lock_guard<std::mutex> lock(mutex_);
    while (!steps_.empty() && steps_.size() >= most) steps_.pop_front();
    if (most > 0) steps_.push_back(std::move(step));
  }
  /// Gives out the one that depends on this; nothing where there is none.
  KeptStep take(const std::vector<double>& of) {
    const std::lock_guard<std::mutex> lock(mutex_);
    for (auto it = steps_.rbegin(); it != steps_.rend(); ++it) {
      if (it->of.size() != of.size() ||
          std::memcmp(it->of.data(), of.data(), of.size() * sizeof(double)) != 0)
        continue;
      KeptStep found = std::move(*it);
      steps_.erase(std::next(it).base());
      return found;
    }
    return {};
  }

 private:
  std::mutex mutex_;
  std::deque<KeptStep> steps_;
};

}  // namespace diffsim
