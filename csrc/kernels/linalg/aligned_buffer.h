// Uninitialised memory aligned for SIMD, on huge pages where the system offers them.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <new>
#include <type_traits>
#include <utility>

#include "kernels/huge_pages.h"

namespace diffsim {

template <typename T>
class AlignedBuffer {
  static_assert(std::is_trivial<T>::value, "contents are never constructed");

 public:
  AlignedBuffer() = default;
  explicit AlignedBuffer(std::size_t count) { resize(count); }
  AlignedBuffer(AlignedBuffer&& other) noexcept { swap(other); }
  AlignedBuffer& operator=(AlignedBuffer&& other) noexcept {
    swap(other);
    return *this;
  }
  ~AlignedBuffer() { std::free(data_); }

  /// At least `count` entries; contents are undefined after growth.
  T* resize(std::size_t count) {
    if (count <= capacity_) return data_;
    std::free(data_);
    data_ = nullptr;
    capacity_ = 0;
    const std::size_t bytes = count * sizeof(T);
    const std::size_t alignment = bytes >= kHugePage ? kHugePage : 64;
    const std::size_t rounded = (bytes + alignment - 1) / alignment * alignment;
    void* memory = nullptr;
    if (posix_memalign(&memory, alignment, rounded) != 0) throw std::bad_alloc();
    on_huge_pages(memory, rounded);
    data_ = static_cast<T*>(memory);
    capacity_ = rounded / sizeof(T);
    return data_;
  }

  void release() { AlignedBuffer().swap(*this); }
  void swap(AlignedBuffer& other) {
    std::swap(data_, other.data_);
    std::swap(capacity_, other.capacity_);
  }
  T* data() { return data_; }
  const T* data() const { return data_; }

 private:
  T* data_ = nullptr;
  std::size_t capacity_ = 0;
};

}  // namespace diffsim
