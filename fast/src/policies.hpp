// Null-space policies that the library ships, as policies.py and manipulability.py have them.
#pragma once
#include "limits.hpp"

constexpr double SEED_SPEED = 5e-4, GROWTH = 1.25, LEAST_ROOM = 1e-4, SAME = 1e-9;

// prod_{j != i} sigma_j for each i
inline void products_of_others(const double* sigma, int s, double* out) {
  double behind = 1.0;
  out[0] = 1.0;
  for (int i = 1; i < s; i++) out[i] = out[i - 1] * sigma[i - 1];
  for (int i = s - 1; i >= 0; i--) out[i] *= behind, behind *= sigma[i];
}

// rate and direction of the steepest ascent of |M step|, M_r = vjp(u_i v_j^T) for lost u_i and the rows v_j of V from
// `rank` on; within the null space where `inside` says so, if it grows there
inline double steepest(Svd& svd, int first, int rank, bool inside, const Vjp& vjp, double* direction) {
  int s = svd.s, n = svd.n, z = n - rank;
  static thread_local double square[MAX * MAX], vectors[MAX * MAX];
  double W[MAX * MAX], values[MAX], row[MAX], total = 0.0;
  svd.square();
  std::fill(square, square + n * n, 0.0);
  for (int i = first; i < s; i++)
    for (int j = rank; j < n; j++) {
      for (int r = 0; r < s; r++)
        for (int c = 0; c < n; c++) W[r * n + c] = svd.U[i * s + r] * svd.V[j * n + c];
      vjp(W, row);
      for (int r = 0; r < n; r++) add(square + r * n, row[r], row, n);
    }
  for (int i = 0; i < n; i++) total += square[i * n + i];
  std::fill(direction, direction + n, 0.0);
  double least = SINGULAR_RATIO * svd.sigma[0];
  if (inside ? total <= least * least : total == 0.0) return 0.0;
  int size = n;
  const double* basis = nullptr;
  if (inside) {
    double turned[MAX * MAX], small[MAX * MAX];
    for (int j = 0; j < z; j++) times(square, svd.V + (rank + j) * n, n, n, turned + j * n);
    for (int i = 0; i < z; i++)
      for (int j = 0; j < z; j++) small[i * z + j] = dot(svd.V + (rank + i) * n, turned + j * n, n);
    eigen(small, z, values, vectors);
    if (z && *std::max_element(values, values + z) > 1e-12 * total) size = z, basis = svd.V + rank * n;
  }
  if (!basis) eigen(square, n, values, vectors);
  // of directions along which it grows as fast that of the first joint with most
  double top = *std::max_element(values, values + size), shares[MAX] = {}, most = 0.0;
  int found = 0, joint = 0;
  for (int i = 0; i < size; i++)
    if (values[i] >= top * (1.0 - SAME)) {
      double* row = square + found++ * n;  // no longer needed
      if (basis) across(vectors + i * z, basis, z, n, row);
      else std::copy(vectors + i * n, vectors + (i + 1) * n, row);
      for (int j = 0; j < n; j++) shares[j] += row[j] * row[j], most = std::max(most, shares[j]);
    }
  while (shares[joint] < most - SAME) joint++;
  for (int i = 0; i < found; i++) add(direction, square[i * n + joint] / std::sqrt(shares[joint]), square + i * n, n);
  return std::sqrt(std::max(top, 0.0));
}

struct Policy {
  enum Kind { ZERO, ATTRACTOR, AVOIDANCE, ASCENT, ROOM, SUM } kind = ZERO;
  double gain = 0.0, max_speed = INF, enough = 0.0;  // infinite: no bound
  bool logarithmic = true;
  std::vector<double> first, second, third, fourth;  // of the joints
  std::vector<Policy> parts;
  std::vector<double> weights;

  void bounded(const double* slope, int n, double dt, double* w) const {
    double steepness = std::sqrt(dot(slope, slope, n)), factor = gain;
    if (std::isfinite(max_speed)) {
      double ramp = dt * max_speed * steepness / GROWTH, longest = max_speed / std::sqrt(1.0 + ramp * ramp);
      if (gain * steepness > longest) factor = longest / steepness;
    }
    for (int j = 0; j < n; j++) w[j] = slope[j] * factor;
  }

  void from_decomposition(Svd& svd, const Vjp& vjp, double dt, double* w) const {
    int s = svd.s, n = svd.n;
    double others[MAX], W[MAX * MAX], mu, factor;
    std::fill(w, w + n, 0.0);
    if (s > n) return;
    double smallest = svd.sigma[s - 1], least = SINGULAR_RATIO * svd.sigma[0];
    products_of_others(svd.sigma, s, others);
    if (logarithmic && std::isfinite(max_speed) && smallest <= least) {
      factor = steepest(svd, svd.rank, svd.rank, true, vjp, w) > 0.0 ? std::min(max_speed, SEED_SPEED) : 0.0;
      for (int j = 0; j < n; j++) w[j] *= factor;
      return;
    }
    bool lost = logarithmic && s > 1 && svd.sigma[s - 2] <= least;
    if (smallest <= least) {
      factor = steepest(svd, lost ? svd.rank : s - 1, lost ? svd.rank : s - 1, false, vjp, w);
      int largest = 0;
      for (int j = 1; j < n; j++)
        if (std::abs(w[j]) > std::abs(w[largest])) largest = j;
      double sign = w[largest] < 0.0 ? -1.0 : 1.0;
      if (lost) factor = factor > 0.0 ? gain / SINGULAR_RATIO : 0.0;
      else factor *= others[s - 1];
      for (int j = 0; j < n; j++) w[j] *= sign * factor;
      if (lost) return;
    } else {
      svd.combined(others, W), vjp(W, w);
    }
    mu = others[0] * svd.sigma[0];
    double floor = SINGULAR_RATIO * svd.sigma[0] * others[s - 1], size = std::max(std::max(mu, floor), 1e-300);
    for (int j = 0; j < n; j++) w[j] = logarithmic ? w[j] / size : w[j] * gain;
    if (logarithmic) bounded(std::copy(w, w + n, W) - n, n, dt, w);
  }

  void climb_room(const double* q, Svd& svd, const Vjp& vjp, double dt, double* w) const {
    int s = svd.s, n = svd.n, m = first.size();  // `first` to `third`: joints that have a range, its middle, its width
    if (s > n || svd.sigma[s - 1] <= SINGULAR_RATIO * svd.sigma[0]) return from_decomposition(svd, vjp, dt, w);
    double shares[2 * MAX], x[MAX], room[MAX], rates[MAX], W[MAX * MAX], sum = 0.0;
    for (int i = 0; i < s; i++) shares[i] = std::pow(1.0 + enough / svd.sigma[i], 2), sum += shares[i];
    for (int i = 0; i < m; i++) {
      x[i] = 2.0 * (q[int(first[i])] - second[i]) / third[i];
      room[i] = std::max(std::max((1.0 - x[i]) * (1.0 + x[i]), 0.0), LEAST_ROOM);
      shares[s + i] = 1.0 / (room[i] * room[i]), sum += shares[s + i];
    }
    for (int i = 0; i < s; i++) rates[i] = shares[i] / sum * enough / ((svd.sigma[i] + enough) * svd.sigma[i]);
    double slope[MAX];
    svd.combined(rates, W), vjp(W, slope);
    for (int i = 0; i < m; i++) slope[int(first[i])] -= shares[s + i] / sum * 4.0 * x[i] / (room[i] * third[i]);
    bounded(slope, n, dt, w);
  }

  // w at joint positions q; the rows' inverse (null where it is ill-conditioned), or their decomposition, made on demand
  void at(const double* q, int n, double dt, const RowInverse* own, LazySvd& svd, const Vjp& vjp,
          double* w) const {
    double part[MAX];
    std::fill(w, w + n, 0.0);
    if (kind == ATTRACTOR)
      for (int j = 0; j < n; j++) w[j] = gain * (first[j] - q[j]);
    else if (kind == AVOIDANCE)  // strength, middle, two over the width, largest speed
      for (int j = 0; j < n; j++) {
        double x = (q[j] - second[j]) * third[j], room = std::max((1.0 - x) * (1.0 + x), 0.0), pull = first[j] * x;
        w[j] = -pull / std::hypot(room * room, pull / fourth[j]);
      }
    else if (kind == ROOM) climb_room(q, svd(), vjp, dt, w);
    else if (kind == ASCENT && !own) from_decomposition(svd(), vjp, dt, w);
    else if (kind == ASCENT) {
      vjp(own->X, part);
      if (logarithmic) bounded(part, n, dt, w);
      else add(w, gain * own->volume, part, n);
    }
    for (size_t i = 0; i < parts.size(); i++) parts[i].at(q, n, dt, own, svd, vjp, part), add(w, weights[i], part, n);
  }
};
