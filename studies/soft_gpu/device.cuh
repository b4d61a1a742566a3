// What both programs share: memory of the device, checks, clocks, sums in a fixed order.
#pragma once

#include <cuda_runtime.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <vector>

namespace study {

inline void check(cudaError_t status, const char* what, int line) {
  if (status == cudaSuccess) return;
  std::fprintf(stderr, "line %d: %s: %s\n", line, what, cudaGetErrorString(status));
  std::exit(1);
}
#define CHECK(call) ::study::check((call), #call, __LINE__)

constexpr int kThreads = 128;
inline int blocks_for(std::size_t count, int size = kThreads) {
  return static_cast<int>((count + static_cast<std::size_t>(size) - 1) /
                          static_cast<std::size_t>(size));
}

/// An array on the device.
template <typename T>
class Buffer {
 public:
  Buffer() = default;
  explicit Buffer(std::size_t size) : size_(size) {
    if (size) CHECK(cudaMalloc(&data_, size * sizeof(T)));
  }
  template <typename U>
  explicit Buffer(const std::vector<U>& values) : Buffer(values.size()) {
    std::vector<T> cast(values.begin(), values.end());
    if (size_) CHECK(cudaMemcpy(data_, cast.data(), size_ * sizeof(T), cudaMemcpyHostToDevice));
  }
  Buffer(Buffer&& other) noexcept : data_(other.data_), size_(other.size_) {
    other.data_ = nullptr;
  }
  Buffer& operator=(Buffer&& other) noexcept {
    std::swap(data_, other.data_);
    std::swap(size_, other.size_);
    return *this;
  }
  ~Buffer() { cudaFree(data_); }
  T* get() const { return data_; }
  std::size_t size() const { return size_; }
  std::vector<T> host() const {
    std::vector<T> out(size_);
    CHECK(cudaMemcpy(out.data(), data_, size_ * sizeof(T), cudaMemcpyDeviceToHost));
    return out;
  }

 private:
  T* data_ = nullptr;
  std::size_t size_ = 0;
};

/// Median milliseconds of a call on a stream, by events; the first call is not counted.
template <typename F>
double device_ms(cudaStream_t stream, int repeats, F&& call) {
  cudaEvent_t begin, end;
  CHECK(cudaEventCreate(&begin));
  CHECK(cudaEventCreate(&end));
  std::vector<float> times;
  call();
  for (int k = 0; k < repeats; ++k) {
    CHECK(cudaEventRecord(begin, stream));
    call();
    CHECK(cudaEventRecord(end, stream));
    CHECK(cudaEventSynchronize(end));
    float ms;
    CHECK(cudaEventElapsedTime(&ms, begin, end));
    times.push_back(ms);
  }
  CHECK(cudaGetLastError());
  std::nth_element(times.begin(), times.begin() + times.size() / 2, times.end());
  return times[times.size() / 2];
}

/// Sum over a warp, in lane 0.
__device__ inline double warp_sum(double v) {
  for (int k = 16; k > 0; k >>= 1) v += __shfl_down_sync(0xffffffffU, v, k);
  return v;
}
/// Sum over a block of any number of warps, in thread 0.
__device__ inline double block_sum(double v) {
  __shared__ double of_warp[32];
  v = warp_sum(v);
  if (threadIdx.x % 32 == 0) of_warp[threadIdx.x / 32] = v;
  __syncthreads();
  const int warps = (blockDim.x + 31) / 32;
  v = threadIdx.x < warps ? of_warp[threadIdx.x] : 0.0;
  if (threadIdx.x < 32) v = warp_sum(v);
  __syncthreads();
  return v;
}

}  // namespace study
