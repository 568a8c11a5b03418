// The program of the law, the nearest velocity within bounds and rows, by a dual active-set method.
//
// Goldfarb and Idnani, "A numerically stable dual method for solving strictly convex quadratic programs" (1983). The
// metric 1 + W^T W has a condition number of 1e8 and is never formed: R with R^T R = 1 + W^T W has its root.
#pragma once
#include "limits.hpp"

struct Program {
  int n;
  double R[MAX * MAX];  // upper triangle
  double J[MAX * MAX];  // R^-1 Q, its columns as rows
  double T[MAX * MAX];  // triangle of the active constraints, columns as rows
  double y[MAX], multipliers[MAX + 1];
  int active[MAX + 1];

  // R of the unit matrix above W (s x n, destroyed), by Householder reflections
  void factor(double* W, int s, int n_) {
    n = n_;
    for (int i = 0; i < n * n; i++) R[i] = i % (n + 1) == 0 ? 1.0 : 0.0;
    for (int k = 0; k < n; k++) {
      double square = 0.0;
      for (int i = 0; i < s; i++) square += W[i * n + k] * W[i * n + k];
      if (square == 0.0) continue;
      double head = R[k * n + k], length = std::sqrt(head * head + square);
      double first = head + (head < 0.0 ? -length : length), scale = 2.0 / (first * first + square);
      for (int j = k + 1; j < n; j++) {
        double t = first * R[k * n + j];
        for (int i = 0; i < s; i++) t += W[i * n + k] * W[i * n + j];
        t *= scale, R[k * n + j] -= t * first;
        for (int i = 0; i < s; i++) W[i * n + j] -= t * W[i * n + k];
      }
      R[k * n + k] = head < 0.0 ? length : -length;
    }
  }

  // argmin |R (u - wish)| within bounds and rows; false where there is no such u
  bool solve(const double* wish, const Bounds& bounds, const Barrier* rows, double* u) {
    // columns of R^-1
    for (int k = 0; k < n; k++) {
      double* column = J + k * n;
      std::fill(column, column + n, 0.0);
      column[k] = 1.0 / R[k * n + k];
      for (int i = k - 1; i >= 0; i--) {
        double t = 0.0;
        for (int j = i + 1; j <= k; j++) t += R[i * n + j] * column[j];
        column[i] = -t / R[i * n + i];
      }
    }
    std::fill(y, y + n, 0.0);
    int number = 0, others = rows ? rows->number : 0;
    bool met[2 * MAX + MAX_ROWS] = {};  // by being active
    double tolerance = FINE;
    for (int j = 0; j < n; j++) tolerance = std::max(tolerance, FINE * std::abs(wish[j]));
    for (int round = 0; round < 50 * (n + others + 1); round++) {
      int worst = -1;
      double most = tolerance;
      for (int j = 0; j < n; j++) {
        double under = bounds.low[j] - wish[j] - y[j], over = y[j] + wish[j] - bounds.high[j];
        if (met[2 * j] || met[2 * j + 1]) continue;  // at one of its bounds, which is within the other
        if (under > most) most = under, worst = 2 * j;
        if (over > most) most = over, worst = 2 * j + 1;
      }
      for (int r = 0; r < others; r++) {
        if (met[2 * n + r]) continue;
        const double* g = rows->G + r * n;
        double under = rows->least[r] - dot(g, wish, n) - dot(g, y, n);
        if (under > most) most = under, worst = 2 * n + r;
      }
      if (worst < 0) {
        // y = J t with T^T t = what the active constraints ask for, twice: the steps above lose half of the digits
        std::fill(y, y + n, 0.0);
        for (int twice = 0; twice < 2; twice++) {
          double t[MAX];
          for (int k = 0; k < number; k++) {
            int c = active[k], j = c / 2;
            if (c >= 2 * n) {
              const double* g = rows->G + (c - 2 * n) * n;
              t[k] = rows->least[c - 2 * n] - dot(g, wish, n) - dot(g, y, n);
            } else {
              t[k] = c % 2 ? wish[j] + y[j] - bounds.high[j] : bounds.low[j] - wish[j] - y[j];
            }
            t[k] = (t[k] - dot(T + k * n, t, k)) / T[k * n + k];
          }
          for (int k = 0; k < number; k++) add(y, t[k], J + k * n, n);
        }
        for (int j = 0; j < n; j++) u[j] = wish[j] + y[j];
        for (int i = 0; i < number; i++)
          if (active[i] < 2 * n) u[active[i] / 2] = active[i] % 2 ? bounds.high[active[i] / 2] : bounds.low[active[i] / 2];
        return true;
      }
      double own = 0.0, left = most;  // multiplier of the new constraint, and by how much it is still violated
      while (true) {
        double d[MAX], r[MAX], z[MAX], square = 0.0, all = 0.0;
        if (worst >= 2 * n) times(J, rows->G + (worst - 2 * n) * n, n, n, d);
        else
          for (int i = 0; i < n; i++) d[i] = worst % 2 ? -J[i * n + worst / 2] : J[i * n + worst / 2];
        for (int i = 0; i < n; i++) all += d[i] * d[i], square += i < number ? 0.0 : d[i] * d[i];
        for (int i = number - 1; i >= 0; i--) {
          double t = d[i];
          for (int k = i + 1; k < number; k++) t -= T[k * n + i] * r[k];
          r[i] = t / T[i * n + i];
        }
        int leaving = -1;
        double dual = INF;
        for (int i = 0; i < number; i++)
          if (r[i] > 0.0 && multipliers[i] / r[i] < dual) dual = multipliers[i] / r[i], leaving = i;
        bool moves = number < n && square > 1e-22 * all;
        if (!moves && most < 1e3 * tolerance) {  // a row that follows from the active ones, but for rounding
          met[worst] = true;
          break;
        }
        double full = moves ? left / square : INF, step = std::min(dual, full);
        if (step == INF) return false;
        for (int i = 0; i < number; i++) multipliers[i] -= step * r[i];
        own += step;
        if (moves) {
          across(d + number, J + number * n, n - number, n, z);
          add(y, step, z, n), left -= step * square;
        }
        if (step == full) {  // the constraint becomes active: the part of d behind is turned into one number
          for (int i = n - 1; i > number; i--) turn(d, i);
          std::copy(d, d + number + 1, T + number * n);
          met[worst] = true, active[number] = worst, multipliers[number++] = own;
          break;
        }
        met[active[leaving]] = false, drop(leaving, number--);
      }
    }
    return false;
  }

 private:
  // the rotation of columns i - 1 and i of J that makes d_i zero
  void turn(double* d, int i) {
    double length = std::sqrt(d[i - 1] * d[i - 1] + d[i] * d[i]);
    if (d[i] == 0.0) return;
    double c = d[i - 1] / length, h = d[i] / length;
    d[i - 1] = length, d[i] = 0.0;
    rotate(J + (i - 1) * n, J + i * n, c, h);
  }

  void rotate(double* x, double* z, double c, double h) {
    for (int j = 0; j < n; j++) {
      double a = x[j], b = z[j];
      x[j] = c * a + h * b, z[j] = c * b - h * a;
    }
  }

  void drop(int leaving, int number) {
    for (int i = leaving; i + 1 < number; i++) {
      active[i] = active[i + 1], multipliers[i] = multipliers[i + 1];
      std::copy(T + (i + 1) * n, T + (i + 1) * n + i + 2, T + i * n);
    }
    for (int i = leaving; i + 1 < number; i++) {
      double a = T[i * n + i], b = T[i * n + i + 1], length = std::sqrt(a * a + b * b);
      if (b == 0.0) continue;
      double c = a / length, h = b / length;
      for (int k = i; k + 1 < number; k++) {
        double x = T[k * n + i], z = T[k * n + i + 1];
        T[k * n + i] = c * x + h * z, T[k * n + i + 1] = c * z - h * x;
      }
      rotate(J + i * n, J + (i + 1) * n, c, h);
    }
  }
};

// as `nearest_within`: rows give way to bounds
inline bool nearest_within(Program& program, const double* wish, const Bounds& bounds, const Barrier* rows, double* u) {
  bool found = program.solve(wish, bounds, rows, u);
  bool any = found || (rows && program.solve(wish, bounds, nullptr, u));
  bounds.clip(any ? u : wish, program.n, u);
  return found;
}
