// Limits of joints and of the hand, and how fast a joint or a frame may approach one, as limits.py has them.
#pragma once
#include "kinematics.hpp"

constexpr double INF = HUGE_VAL;
constexpr double RESERVE = 1e-3, RETURN_SPEED = 0.25, ROOM_TO_LEAVE = 0.1, OUTSIDE = 1e-9, AT_BOUND = 1e-7;
constexpr double FINE = 1e-13, APPROACH_RATE = 20.0, BRAKING_SHARE = 0.5, CROSSING_SPEED = 5e-4, ROUNDED = 1e-12;
constexpr int MOST_ROWS = 12, MAX_ROWS = 256;  // cutting planes at most, and rows of a program
constexpr int POSITION = 0, VELOCITY = 1, ACCELERATION = 2;

// rows G u >= least (number x nv)
struct Barrier {
  int number = 0;
  double G[MAX_ROWS * MAX], least[MAX_ROWS];

  bool append(const double* row, double bound, int n) {
    if (number == MAX_ROWS) return false;
    std::copy(row, row + n, G + number * n), least[number++] = bound;
    return true;
  }
};

inline double approach_rate(double distance, const double* slope, const double* acceleration, int n, double dt) {
  double largest = 0.0, square = dot(slope, slope, n);
  for (int j = 0; j < n; j++) largest = std::max(largest, std::abs(slope[j]) / acceleration[j]);
  double deceleration = largest > 0.0 ? BRAKING_SHARE * square / largest : INF;
  double rate = std::min(APPROACH_RATE, 0.5 / dt) * distance, left = std::max(distance, 0.0);
  return std::min(rate, left > 0.0 ? std::sqrt(2.0 * deceleration * left) : 0.0);
}

inline double approach_bound(double smallest, const double* slope, const double* acceleration, int n, double dt) {
  double length = std::sqrt(dot(slope, slope, n));
  if (length == 0.0) return INF;
  return length * CROSSING_SPEED + approach_rate(smallest, slope, acceleration, n, dt);
}

struct Approach {
  double free, rate, linear, offset, twice, half, fastest;

  Approach(double velocity, double acceleration, double dt) {
    acceleration *= BRAKING_SHARE, rate = std::min(APPROACH_RATE, 0.5 / dt);
    double v = std::min(velocity, 1e6);
    fastest = RETURN_SPEED * v;
    if (!std::isfinite(acceleration)) {
      free = v / rate, linear = INF, offset = twice = half = 0.0;
      return;
    }
    twice = 2.0 * acceleration, half = 0.5 * acceleration * dt;
    double joined = acceleration / rate - half;
    linear = joined / rate, offset = linear - joined * (joined + acceleration * dt) / twice;
    free = v <= joined ? v / rate : offset + v * (v + acceleration * dt) / twice;
  }

  double speed(double distance, double together) const {
    double brake = distance <= linear ? std::max(rate * distance, -fastest)
                                      : std::sqrt(half * half + twice * (distance - offset)) - half;
    return together > 0.0 && distance > 0.0 ? std::min(brake, distance / together) : brake;
  }
};

struct Bounds {
  double low[MAX], high[MAX], outside;
  int low_cause[MAX], high_cause[MAX];

  bool admit(const double* u, int n) const {
    for (int j = 0; j < n; j++)
      if (!(low[j] - u[j] <= FINE && u[j] - high[j] <= FINE)) return false;
    return true;
  }

  void clip(const double* u, int n, double* out) const {
    for (int j = 0; j < n; j++) out[j] = std::min(std::max(u[j], low[j]), high[j]);
  }

  void binding(const double* u, const double* wish, int n, int& joint, int& cause) const {
    double most = FINE;
    joint = cause = -1;
    for (int j = 0; j < n; j++) {
      double met = AT_BOUND * (1.0 + std::abs(u[j]));
      if (low[j] <= wish[j] && wish[j] <= high[j]) continue;
      if (wish[j] - high[j] > most && u[j] >= high[j] - met) joint = j, cause = high_cause[j], most = wish[j] - high[j];
      else if (low[j] - wish[j] > most && u[j] <= low[j] + met) joint = j, cause = low_cause[j], most = low[j] - wish[j];
    }
  }
};

// rows by which Python keeps pairs apart that a velocity would bring too near
using Cuts = std::function<void(const double* u, Barrier& rows)>;

// The limits of frames, see Barriers, and the frames at one posture
struct TipLimits {
  std::vector<Chain> frames;
  std::vector<double> walls;  // (w x 4), normals of unit length
  double speed = INF;

  struct At {
    std::vector<double> jacobians;  // each (3 x nv)
    Barrier walls;
    const Cuts* clear = nullptr;
  };

  void at(const double* q, int n, double dt, const double* acceleration, const double* previous, At& out) const {
    out.jacobians.resize(frames.size() * 3 * n), out.walls.number = 0;
    static constexpr double LINEAR[18] = {1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0};
    double finite[MAX];
    for (int j = 0; j < n; j++) finite[j] = std::min(acceleration[j], 1e12);
    for (size_t f = 0; f < frames.size(); f++) {
      Twists twists;
      double* J = &out.jacobians[f * 3 * n];
      frames[f].at(q, false, twists);
      frames[f].rows(twists, LINEAR, 3, n, J);
      for (size_t w = 0; w + 3 < walls.size(); w += 4) {
        double g[MAX], reach = 0.0, p[3] = {twists.position.x, twists.position.y, twists.position.z};
        across(&walls[w], J, 3, n, g);
        double least = -approach_rate(walls[w + 3] - dot(&walls[w], p, 3), g, finite, n, dt);
        for (int j = 0; j < n; j++) reach += std::abs(g[j]) * finite[j];
        if (previous) least = std::min(least, BRAKING_SHARE * dt * reach - dot(g, previous, n));
        for (int j = 0; j < n; j++) g[j] = -g[j];
        out.walls.append(g, least, n);
      }
    }
  }

  // what the velocity u breaks is appended; whether that is anything
  bool rows(const At& tips, const double* u, int n, double slack, Barrier& rows, bool* near = nullptr) const {
    bool broken = false;
    for (int w = 0; w < tips.walls.number; w++)
      if (dot(tips.walls.G + w * n, u, n) < tips.walls.least[w] - slack) {
        broken = true, rows.append(tips.walls.G + w * n, tips.walls.least[w], n);
        if (near) *near = true;
      }
    if (int before = rows.number; tips.clear && ((*tips.clear)(u, rows), rows.number > before)) {
      broken = true;
      if (near) *near = true;
    }
    for (size_t f = 0; f < frames.size(); f++) {
      const double* J = &tips.jacobians[f * 3 * n];
      double v[3], row[MAX];
      times(J, u, 3, n, v);
      double fast = std::sqrt(dot(v, v, 3));
      if (!(fast > speed)) continue;
      for (double& x : v) x /= -fast;
      across(v, J, 3, n, row);
      broken = true, rows.append(row, speed * (RESERVE - 1.0), n);
    }
    return broken;
  }
};

struct Limits {
  int n = 0;
  bool given = false, has_tip = false;
  std::vector<double> lower, upper, velocity, acceleration;
  double weakest = INF;
  TipLimits tip;

  std::vector<Approach> approaches(double dt) const {
    std::vector<Approach> out;
    for (int j = 0; j < n; j++) out.emplace_back(velocity[j], acceleration[j], dt);
    return out;
  }

  // no joint is near a position limit, or faster than its velocity limit
  bool far(const double* q, const Approach* approach, const double* u) const {
    for (int j = 0; j < n; j++) {
      bool inside = lower[j] + approach[j].free <= q[j] && q[j] <= upper[j] - approach[j].free;
      if (!(inside && std::abs(u[j]) <= velocity[j])) return false;
    }
    return true;
  }

  double stopping_time(const double* u) const {
    double time = 0.0;
    for (int j = 0; j < n; j++) time = std::max(time, std::abs(u[j]) / acceleration[j]);
    return time;
  }

  void bounds(const double* q, double dt, const Approach* approach, const double* previous, Bounds& out) const {
    double outside = 0.0, together = previous ? stopping_time(previous) : 0.0;
    for (int j = 0; j < n; j++) {
      double &low = out.low[j], &high = out.high[j];
      low = -velocity[j], high = velocity[j], out.low_cause[j] = out.high_cause[j] = VELOCITY;
      double below = q[j] - lower[j], above = upper[j] - q[j], free = approach[j].free, fastest;
      if (!(lower[j] + free <= q[j] && q[j] <= upper[j] - free) || together * velocity[j] > free) {
        if ((fastest = approach[j].speed(above, together)) < high) high = fastest, out.high_cause[j] = POSITION;
        if ((fastest = approach[j].speed(below, together)) < velocity[j])
          low = -fastest, out.low_cause[j] = POSITION;
        if (below < 0.0 || above < 0.0) outside = std::max(outside, std::max(-below, -above));
      }
      if (!previous) continue;
      double slowest = previous[j] - acceleration[j] * dt;
      fastest = previous[j] + acceleration[j] * dt;
      if (slowest > low) low = slowest, out.low_cause[j] = ACCELERATION;
      if (fastest < high) high = fastest, out.high_cause[j] = ACCELERATION;
      if (low > high) low = high = high < slowest ? slowest : fastest;
    }
    out.outside = outside > OUTSIDE ? outside : 0.0;
  }

  bool may_approach(double square, double size, double smallest, double dt) const {
    double rate = std::min(APPROACH_RATE, 0.5 / dt) * smallest;
    return square * size >= std::min(2.0 * BRAKING_SHARE * weakest * std::sqrt(size) * smallest, rate * rate);
  }

  // the opposite of a direction where position limits leave that more room
  void freer_sense(const double* q, double* direction) const {
    double fastest = 0.0, ahead = INF, behind = INF;
    for (int j = 0; j < n; j++) fastest = std::max(fastest, std::abs(direction[j]));
    for (int j = 0; j < n; j++) {
      double speed = std::abs(direction[j]);
      if (!(speed > 1e-3 * fastest)) continue;
      double up = (upper[j] - q[j]) / speed, down = (q[j] - lower[j]) / speed;
      ahead = std::min(ahead, direction[j] > 0.0 ? up : down), behind = std::min(behind, direction[j] > 0.0 ? down : up);
    }
    if (fastest == 0.0 || ahead >= std::min(behind, ROOM_TO_LEAVE / fastest)) return;
    for (int j = 0; j < n; j++) direction[j] = -direction[j];
  }
};
