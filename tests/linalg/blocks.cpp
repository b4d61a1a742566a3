// Rows of 3x3 blocks, in float64 and as 16-bit integers, against sums that are written out.
// Prints "right", or what is not.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <vector>

#include "kernels/linalg/block3.h"

using namespace diffsim;

namespace {

constexpr int kNodes = 40, kRow = 9;  // blocks of a row, the diagonal's included

void require(bool holds, const char* what) {
  if (holds) return;
  std::printf("wrong: %s\n", what);
  std::exit(1);
}

/// A symmetric matrix whose nodes differ in stiffness by up to six digits.
struct Matrix {
  std::vector<std::int32_t> column;
  std::vector<double> values = std::vector<double>(kNodes * kRow * kBlock3 + kBehindBlocks3);

  Matrix() {
    std::mt19937 random(1);
    std::uniform_real_distribution<double> uniform(-1.0, 1.0);
    for (int i = 0; i < kNodes; ++i)
      for (int k = 0; k < kRow; ++k) {
        const int j = (i + (k - kRow / 2) + kNodes) % kNodes;
        column.push_back(j);
        const double stiffness = std::pow(10.0, 3.0 * ((i % 3 == 0) + (j % 3 == 0)));
        for (int n = 0; n < kBlock3; ++n) values[at(i, k) + n] = stiffness * uniform(random);
      }
    for (int i = 0; i < kNodes; ++i)
      for (int k = 0; k < kRow; ++k)
        for (int a = 0; a < 3; ++a)
          for (int b = 0; b < 3; ++b)
            values[at(column[i * kRow + k], kRow - 1 - k) + block3_place(b, a)] =
                values[at(i, k) + block3_place(a, b)];
  }
  static std::size_t at(int row, int k) {
    return static_cast<std::size_t>(row * kRow + k) * kBlock3;
  }
};

/// Sum over the blocks of a row, the diagonal's too; `skip` = its place or -1.
double written_out(const Matrix& m, int i, int a, const std::vector<double>& x, int skip) {
  double total = 0.0;
  for (int k = 0; k < kRow; ++k)
    for (int b = 0; b < 3 && k != skip; ++b)
      total += m.values[Matrix::at(i, k) + block3_place(a, b)] *
               x[static_cast<std::size_t>(3 * m.column[i * kRow + k] + b)];
  return total;
}

}  // namespace

int main(int count, char** given) {
  const double mistake = count > 1 ? std::atof(given[1]) : 0.0;  // of the scales
  const Matrix m;
  std::mt19937 random(2);
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  std::vector<double> x(3 * kNodes);
  for (double& v : x) v = uniform(random);
  for (int i = 0; i < kNodes; ++i) {
    double y[3];
    block3_row(m.values.data(), m.column.data(), i * kRow, (i + 1) * kRow, x.data(), y);
    for (int a = 0; a < 3; ++a)
      require(std::abs(y[a] - written_out(m, i, a, x, -1)) < 1e-8, "a row in float64");
  }

  std::vector<float> scale(kNodes), scaled_x(3 * kNodes);
  std::vector<float> diagonal(kNodes * kBlock3 + kBehindBlocks3);
  std::vector<std::int16_t> shorts(kNodes * kRow * kBlock3 + kBehindBlocks3);
  for (int i = 0; i < kNodes; ++i) {
    Largest3 largest;
    double most = 0.0;
    for (int k = 0; k < kRow; ++k)
      if (k != kRow / 2) {
        largest.take(m.values.data() + Matrix::at(i, k));
        for (int n = 0; n < kBlock3; ++n)
          most = std::max(most, std::abs(m.values[Matrix::at(i, k) + n]));
      }
    require(std::abs(largest.value() - most) <= 1e-6 * most, "the largest of some blocks");
    scale[i] = static_cast<float>((1.0 + mistake) * std::sqrt(most / (kLargestShort * kShortUnit)));
    for (int a = 0; a < 3; ++a) scaled_x[3 * i + a] = static_cast<float>(x[3 * i + a]) * scale[i];
  }
  for (int i = 0; i < kNodes; ++i) {
    Rounding3 rounding;
    double lost[kBlock3] = {};
    for (int k = 0; k < kRow; ++k) {
      const int j = m.column[i * kRow + k];
      const float unit = k == kRow / 2 ? 0.0F : 1.0F / (scale[i] * scale[j] * kShortUnit);
      const double* block = m.values.data() + Matrix::at(i, k);
      std::int16_t* to = shorts.data() + Matrix::at(i, k);
      rounding.write(block, unit, scale[j], to);
      float whole[kBlock3];
      scale_block3(block, unit, whole);
      for (int n = 0; n < kBlock3; ++n) {
        require(std::abs(static_cast<double>(to[n]) - whole[n]) <= 0.501, "a rounded number");
        lost[n] += static_cast<double>(scale[j]) * (static_cast<double>(whole[n]) - to[n]);
      }
      if (k == kRow / 2)
        for (int n = 0; n < kBlock3; ++n)
          diagonal[i * kBlock3 + n] = static_cast<float>(block[n]) / (scale[i] * scale[i]);
    }
    for (int n = 0; n < kBlock3; ++n)
      require(std::abs(lost[n] - rounding.lost(n)) < 1e-3 * scale[0] * kRow, "what is lost");
  }
  for (int i = 0; i < kNodes; ++i) {
    float y[3];
    short_block3_row(shorts.data(), diagonal.data(), m.column.data(), i, i * kRow, (i + 1) * kRow,
                     scaled_x.data(), y);
    double bound = 0.0;  // half a unit of every block, and float32's rounding
    for (int k = 0; k < kRow; ++k)
      bound += 1.5 * (0.5 * kShortUnit * scale[i] * scale[m.column[i * kRow + k]]);
    for (int a = 0; a < 3; ++a) {
      const double exact = written_out(m, i, a, x, -1);
      const double own = std::abs(exact - written_out(m, i, a, x, kRow / 2));
      require(std::abs(scale[i] * static_cast<double>(y[a]) - exact) <= bound + 1e-5 * own,
              "a row of 16-bit integers");
    }
  }
  std::printf("right\n");
}
