// Decompositions of one matrix as small as a constraint's, as small_matrices.py and linalg.py have them. Row-major.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstring>

constexpr int MAX = 32;  // rows, and joints: an arm with more keeps the Python law
constexpr double EPS = 2.220446049250313e-16, SINGULAR_RATIO = 64.0 * EPS, LEAST_SINGULAR_RATIO = 0.04;

inline double dot(const double* a, const double* b, int n) {
  double sum = 0.0;
  for (int i = 0; i < n; i++) sum += a[i] * b[i];
  return sum;
}

inline void add(double* y, double factor, const double* x, int n) {
  for (int i = 0; i < n; i++) y[i] += factor * x[i];
}

// y = M x, M (r x c)
inline void times(const double* M, const double* x, int r, int c, double* y) {
  for (int i = 0; i < r; i++) y[i] = dot(M + i * c, x, c);
}

// y = x M
inline void across(const double* x, const double* M, int r, int c, double* y) {
  std::fill(y, y + c, 0.0);
  for (int i = 0; i < r; i++) add(y, x[i], M + i * c, c);
}

// A A^T, (s x s)
inline void gram(const double* A, int s, int n, double* G) {
  for (int i = 0; i < s; i++)
    for (int k = 0; k <= i; k++) G[i * s + k] = G[k * s + i] = dot(A + i * n, A + k * n, n);
}

// G X = B for positive definite G (s x s, destroyed) and B (s x n) in the place of X; false if G is none
inline bool solve_definite(double* G, int s, double* B, int n) {
  for (int i = 0; i < s; i++)
    for (int k = 0; k <= i; k++) {
      double t = G[i * s + k] - dot(G + i * s, G + k * s, k);
      if (k < i) G[i * s + k] = t / G[k * s + k];
      else if (!(t > 0.0)) return false;
      else G[i * s + i] = std::sqrt(t);
    }
  for (int i = 0; i < s; i++) {
    for (int k = 0; k < i; k++) add(B + i * n, -G[i * s + k], B + k * n, n);
    for (int j = 0; j < n; j++) B[i * n + j] /= G[i * s + i];
  }
  for (int i = s - 1; i >= 0; i--) {
    for (int k = i + 1; k < s; k++) add(B + i * n, -G[k * s + i], B + k * n, n);
    for (int j = 0; j < n; j++) B[i * n + j] /= G[i * s + i];
  }
  return true;
}

// eigenvalues of a symmetric G (s x s, destroyed), unsorted, and the eigenvectors as rows of V where it is given
inline void eigen(double* G, int s, double* values, double* V = nullptr) {
  if (V)
    for (int i = 0; i < s * s; i++) V[i] = i % (s + 1) == 0 ? 1.0 : 0.0;
  double tiny = 0.0;
  for (int i = 0; i < s; i++) tiny += 1e-17 * G[i * s + i];
  for (int sweep = 0; sweep < 30; sweep++) {
    bool turned = false;
    for (int p = 0; p < s; p++)
      for (int q = p + 1; q < s; q++) {
        double g = G[p * s + q], a = G[p * s + p], b = G[q * s + q];
        if (std::abs(g) <= tiny) continue;
        turned = true;
        double theta = 0.5 * (b - a) / g;
        double t = (theta < 0.0 ? -1.0 : 1.0) / (std::abs(theta) + std::sqrt(1.0 + theta * theta));
        double c = 1.0 / std::sqrt(1.0 + t * t), h = c * t;
        for (int k = 0; k < s; k++) {
          double x = G[p * s + k], y = G[q * s + k];
          G[p * s + k] = c * x - h * y, G[q * s + k] = h * x + c * y;
          if (V) x = V[p * s + k], y = V[q * s + k], V[p * s + k] = c * x - h * y, V[q * s + k] = h * x + c * y;
        }
        for (int k = 0; k < s; k++) {
          double x = G[k * s + p], y = G[k * s + q];
          G[k * s + p] = c * x - h * y, G[k * s + q] = h * x + c * y;
        }
        G[p * s + q] = G[q * s + p] = 0.0;
      }
    if (!turned) break;
  }
  for (int i = 0; i < s; i++) values[i] = G[i * s + i];
}

struct Svd {
  int s, n, k;            // of A (s x n), k = min(s, n)
  double U[MAX * MAX];    // left vectors as rows (k x s)
  double sigma[MAX];      // falling
  double V[MAX * MAX];    // right vectors as rows (k x n), and behind those of the rank a basis of the null space
  int rank;               // singular values above SINGULAR_RATIO times the largest
  bool squared;           // whether V has n rows already
  double work[MAX * MAX];

  // one-sided Jacobi rotations: accurate for singular values of any size
  void of(const double* A, int s_, int n_) {
    s = s_, n = n_, k = std::min(s, n), squared = false;
    bool wide = s <= n;
    int length = wide ? n : s;
    double *turned = work, *turns = wide ? U : V;
    if (wide) std::copy(A, A + s * n, turned);
    else
      for (int i = 0; i < s; i++)
        for (int j = 0; j < n; j++) turned[j * s + i] = A[i * n + j];
    for (int i = 0; i < k * k; i++) turns[i] = i % (k + 1) == 0 ? 1.0 : 0.0;
    for (int sweep = 0; sweep < 40; sweep++) {
      bool again = false;
      for (int p = 0; p < k; p++)
        for (int q = p + 1; q < k; q++) {
          double *x = turned + p * length, *y = turned + q * length;
          double g = dot(x, y, length), a = dot(x, x, length), b = dot(y, y, length);
          if (std::abs(g) <= 2.0 * EPS * std::sqrt(a * b) || g == 0.0) continue;
          again = true;
          double theta = 0.5 * (b - a) / g;
          double t = (theta < 0.0 ? -1.0 : 1.0) / (std::abs(theta) + std::sqrt(1.0 + theta * theta));
          double c = 1.0 / std::sqrt(1.0 + t * t), h = c * t;
          auto turn = [c, h](double* x, double* y, int size) {
            for (int i = 0; i < size; i++) {
              double u = x[i], v = y[i];
              x[i] = c * u - h * v, y[i] = h * u + c * v;
            }
          };
          turn(x, y, length), turn(turns + p * k, turns + q * k, k);
        }
      if (!again) break;
    }
    for (int i = 0; i < k; i++) sigma[i] = std::sqrt(dot(turned + i * length, turned + i * length, length));
    for (int i = 0; i < k; i++) {  // largest first
      int best = i;
      for (int j = i + 1; j < k; j++)
        if (sigma[j] > sigma[best]) best = j;
      if (best == i) continue;
      std::swap(sigma[i], sigma[best]);
      std::swap_ranges(turned + i * length, turned + (i + 1) * length, turned + best * length);
      std::swap_ranges(turns + i * k, turns + (i + 1) * k, turns + best * k);
    }
    for (rank = 0; rank < k && sigma[rank] > SINGULAR_RATIO * sigma[0]; rank++) {}
    double* out = wide ? V : U;
    for (int i = 0; i < k; i++)
      for (int j = 0; j < length; j++) out[i * length + j] = i < rank ? turned[i * length + j] / sigma[i] : 0.0;
    if (wide && rank < k) square();
  }

  // the null space behind the rows of V: unit vectors, the one that lies deepest in what remains first
  void square() {
    if (squared) return;
    for (int i = rank; i < n; i++) {
      double most = -1.0, *row = V + i * n;
      int axis = 0;
      for (int j = 0; j < n; j++) {
        double left = 1.0;
        for (int r = 0; r < i; r++) left -= V[r * n + j] * V[r * n + j];
        if (left > most) most = left, axis = j;
      }
      std::fill(row, row + n, 0.0);
      row[axis] = 1.0;
      for (int twice = 0; twice < 2; twice++)
        for (int r = 0; r < i; r++) add(row, -dot(row, V + r * n, n), V + r * n, n);
      double length = std::sqrt(dot(row, row, n));
      for (int j = 0; j < n; j++) row[j] /= length;
    }
    squared = true;
  }

  // sum_i factor_i u_i v_i^T, (s x n)
  void combined(const double* factors, double* W) const {
    std::fill(W, W + s * n, 0.0);
    for (int i = 0; i < k; i++)
      for (int r = 0; r < s; r++) add(W + r * n, factors[i] * U[i * s + r], V + i * n, n);
  }
};

// a decomposition that is made when it is first asked for
struct LazySvd {
  Svd& svd;
  const double* A;
  int s, n;
  bool made = false;
  Svd& operator()() {
    if (!made) svd.of(A, s, n), made = true;
    return svd;
  }
};

struct RowInverse {
  double X[MAX * MAX], volume, smallest;
  double G[MAX * MAX], copy[MAX * MAX], values[MAX];

  // A^{+T} = (A A^T)^-1 A, sqrt(det(A A^T)) and the smallest singular value; false if A is too ill-conditioned
  bool of(const double* A, int s, int n) {
    if (s > n) return false;
    gram(A, s, n, G);
    if (s == 2) {
      double a = G[0], b = G[1], c = G[3];
      double square = a * c - b * b, largest = 0.5 * (a + c) + std::hypot(0.5 * (a - c), b);
      if (!(square > LEAST_SINGULAR_RATIO * LEAST_SINGULAR_RATIO * largest * largest)) return false;
      for (int j = 0; j < n; j++) {
        X[j] = c / square * A[j] - b / square * A[n + j];
        X[n + j] = a / square * A[n + j] - b / square * A[j];
      }
      volume = std::sqrt(square), smallest = std::sqrt(square / largest);
      return true;
    }
    std::copy(G, G + s * s, copy), std::copy(A, A + s * n, X);
    if (!solve_definite(G, s, X, n)) return false;
    volume = 1.0;
    for (int i = 0; i < s; i++) volume *= G[i * s + i];
    smallest = volume;
    if (s == 1) return true;
    eigen(copy, s, values);
    double least = *std::min_element(values, values + s), largest = *std::max_element(values, values + s);
    if (!(least > LEAST_SINGULAR_RATIO * LEAST_SINGULAR_RATIO * largest)) return false;
    smallest = std::sqrt(least);
    return true;
  }
};
