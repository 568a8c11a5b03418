// One step of the law, section by section as law.py has it.
#pragma once
#include <memory>

#include "policies.hpp"
#include "program.hpp"

constexpr double HELD = 0.1, ACROSS = 1e-4, ALONG = 3e-3, ESCAPE_WIDTH = 0.6, ESCAPE_SPEED = 0.2, SEED_SHARE = 6e-4;
constexpr double ASIDE = 1e-3, STABLE_SLOPE = 0.5, AT_GOAL = 1e-6;
constexpr double SOME = 0.1, SLIDING_AFTER = 0.1, STALLED_AFTER = 0.25, KEEPING_AFTER = 1.0, NEARBY = 2e-3;
constexpr double SLIDING_BELOW = 0.5, GOING_ON = 0.9;
constexpr double ROUNDING = 1e-9, STALLED_BELOW = 0.02, SCALED_BELOW = 0.999;
constexpr int LAW_VERSION = 3;  // as in controller.py: it grows whenever a number of the law changes
// in the order of `Status`
enum Status { OUTSIDE_LIMITS = 4, SINGULAR, STALLED, POSITION_LIMITED, VELOCITY_LIMITED, ACCELERATION_LIMITED, DAMPED,
              REROUTED, NULL_SCALED, OK };

inline M3 skew(V3 r) { return {{0, -r.z, r.y, r.z, 0, -r.x, -r.y, r.x, 0}}; }

inline V3 rotation_vector(const M3& R) {
  const double* m = R.m;
  double parts[4] = {m[0] + m[4] + m[8], m[0] - m[4] - m[8], m[4] - m[0] - m[8], m[8] - m[0] - m[4]};
  int largest = std::max_element(parts, parts + 4) - parts;
  double all[4][4] = {{1.0 + parts[0], m[7] - m[5], m[2] - m[6], m[3] - m[1]},
                      {m[7] - m[5], 1.0 + parts[1], m[1] + m[3], m[2] + m[6]},
                      {m[2] - m[6], m[1] + m[3], 1.0 + parts[2], m[5] + m[7]},
                      {m[3] - m[1], m[2] + m[6], m[5] + m[7], 1.0 + parts[3]}};
  const double* quaternion = all[largest];
  double w = quaternion[0], length = std::sqrt(dot(quaternion + 1, quaternion + 1, 3));
  if (length == 0.0) return {0, 0, 0};
  double scale = 2.0 * std::atan2(length, std::abs(w)) / length;
  return (w < 0.0 ? -scale : scale) * V3{quaternion[1], quaternion[2], quaternion[3]};
}

inline M3 left_jacobian_inverse(V3 r) {
  double square = dot(r, r), angle = std::sqrt(square), half = 0.5 * angle;
  double second = angle < 0.1 ? 1.0 / 12.0 + square / 720.0 * (1.0 + square / 42.0 * (1.0 + square / 40.0))
                              : (1.0 - half * std::cos(half) / std::sin(half)) / square;
  M3 K = skew(r), KK = K * K, out;
  for (int i = 0; i < 9; i++) out.m[i] = (i % 4 == 0 ? 1.0 : 0.0) - 0.5 * K.m[i] + second * KK.m[i];
  return out;
}

struct Task {
  enum Kind { GIVEN, HOLD, PLACE, POSE } kind = GIVEN;
  bool slides = true;
  double gain = 1.0, max_speed = INF;
  std::vector<double> goal, selection;  // PLACE: along the rows, (s x 3); POSE: (s x 6)
  V3 place{}, given{};                  // where the frame shall be; 1 where that is given, else 0
  M3 rotation{};

  // what is left along the rows, and with it E, where that is not A
  bool displacement(const Rows& rows, const Twists& J, int nv, double* out, double* E) const {
    int s = rows.s;
    if (kind == HOLD) std::fill(out, out + s, 0.0);
    if (kind == PLACE)
      for (int i = 0; i < s; i++)
        out[i] = goal[i] - dot(V3{selection[3 * i], selection[3 * i + 1], selection[3 * i + 2]}, J.position);
    if (kind != POSE) return false;
    M3 back;
    for (int i = 0; i < 9; i++) back.m[i] = J.rotation.m[3 * (i % 3) + i / 3];
    V3 left = place - J.position, turn = rotation_vector(rotation * back);
    left = {left.x * given.x, left.y * given.y, left.z * given.z};
    if (rows.own_axes) left = turned_back(J.rotation, left), turn = turned_back(J.rotation, turn);
    double error[6] = {left.x, left.y, left.z, turn.x, turn.y, turn.z};
    times(selection.data(), error, s, 6, out);
    if (!E) return true;
    Twists rates = J;
    M3 M = left_jacobian_inverse(rows.own_axes ? turn : -1.0 * turn);
    for (size_t j = 0; j < rows.chain.joints.size(); j++) {
      if (rows.own_axes) rates.v[j] = J.v[j] - cross(left, J.w[j]);
      rates.w[j] = M * J.w[j];
    }
    rows.chain.rows(rates, selection.data(), s, nv, E);
    return true;
  }

  void attraction(double* b, int s) const {
    for (int i = 0; i < s; i++) b[i] *= gain;
    double speed = std::sqrt(dot(b, b, s));
    if (speed > max_speed)
      for (int i = 0; i < s; i++) b[i] *= max_speed / speed;
  }
};

// what Python has computed for a step; null where the engine does
struct Given {
  const double *A = nullptr, *b = nullptr, *E = nullptr, *D = nullptr, *w = nullptr, *bend = nullptr;
  int driven = 0;
  const Vjp* rates = nullptr;
  const Cuts* clear = nullptr;
};

struct Outcome {
  double velocity[MAX], b[MAX], bend[MAX], task[MAX], null[MAX], escape[MAX], mu, smallest, task_scale, null_scale, progress, outside;
  bool near;  // to a singularity, where there is an escape part
  int s, status, joint;
};

struct Workspace {
  Rows::At here, ahead;
  Twists J;
  double A[MAX * MAX], E[MAX * MAX], D[MAX * MAX], Y[MAX * MAX], W[MAX * MAX], G[MAX * MAX], w[MAX], slope[MAX];
  RowInverse own, other;
  Svd of_A, of_rows;
  Bounds bounds;
  Barrier barrier;
  TipLimits::At tips;
  Program program;
};

struct Law {
  int n = 0, s = 0;
  bool known = false;  // whether `rows` are those of the constraint
  bool damped = true, ascends = false;
  double threshold = 0.05, damping = 0.05;
  Rows rows;
  Task task;
  Policy policy;
  bool has_policy = false;
  Limits limits;

  // one step, with the wishes of the law in a few words where Python's are longer; false where Python has to do it
  bool command(Workspace& ws, const double* q, double dt, const Approach* approach, const double* previous, double slide,
               const Given& given, Outcome& out) const {
    for (int j = 0; j < n; j++)
      if (!std::isfinite(q[j])) return false;
    const double *A = given.A, *b = out.b, *E = given.E;
    Vjp own_rates, *none = nullptr;
    const Vjp* vjp = given.rates ? given.rates : none;
    if (known) {
      rows.at(q, n, ws.here, ws.A);
      struct Both { const Law* law; Workspace* ws; } both{this, &ws};
      own_rates = [both](const double* W, double* g) { both.law->rows.vjp(both.ws->here, both.law->n, W, g); };
      A = ws.A, vjp = &own_rates;
    }
    if (given.b) std::copy(given.b, given.b + s, out.b);
    else {
      if (task.displacement(rows, ws.here.J, n, out.b, ws.E)) E = ws.E;
      task.attraction(out.b, s);
    }
    int driven = given.b ? given.driven : task.kind == Task::HOLD ? 0 : s;
    const double* D = given.b ? given.D : nullptr;  // null where all rows are driven, or none
    const double* R = E ? E : A;
    bool well = ws.own.of(A, s, n), fits = well;
    if (E) fits = ws.other.of(E, s, n);
    const RowInverse& inverse = E ? ws.other : ws.own;
    LazySvd svd_of_A{ws.of_A, A, s, n};
    if (given.w) std::copy(given.w, given.w + n, ws.w);
    else policy.at(q, n, dt, well ? &ws.own : nullptr, svd_of_A, *vjp, ws.w);
    const double *basis, *Y;
    double lambda = 0.0;
    int rank = s;
    out.s = s, out.mu = ws.own.volume, out.smallest = ws.own.smallest;
    out.near = !(well && fits) || (damped && std::min(ws.own.smallest, inverse.smallest) < threshold);
    if (out.near) {
      if (!damped) return false;
      const Svd& svd = near_singularity(ws, q, A, R, D, driven, dt, *vjp, svd_of_A, out, lambda);
      basis = svd.V, Y = ws.Y, rank = svd.rank;
    } else {
      double moved[MAX];
      basis = Y = inverse.X;
      across(b, Y, s, n, out.task), times(R, ws.w, s, n, moved), across(moved, Y, s, n, out.null);
      for (int j = 0; j < n; j++) out.null[j] = ws.w[j] - out.null[j];
    }
    double wish[MAX], asked[MAX], drive[MAX], rest[MAX];
    for (int j = 0; j < n; j++) wish[j] = out.task[j] + out.null[j] + (out.near ? out.escape[j] : 0.0);
    std::fill(out.bend, out.bend + s, 0.0);
    if (limits.given && previous) {
      straighten(ws, q, dt, A, previous, given, out);
      double less[MAX];
      across(out.bend, Y, s, n, less);
      for (int j = 0; j < n; j++) out.task[j] -= less[j], wish[j] -= less[j];
    }
    for (int j = 0; j < n; j++)
      if (!std::isfinite(wish[j])) return false;
    out.joint = -1, out.outside = 0.0, out.task_scale = out.null_scale = 1.0;
    bool has_tip = limits.has_tip || given.clear;
    bool lost = is_lost(R, out), weak = damped && out.near && out.smallest < threshold;
    if (!limits.given) return unconstrained_command(R, wish, lost, weak, out);
    bool far = !previous && limits.far(q, approach, wish);
    bool closer = approaches(ws, R, wish, dt, *vjp, svd_of_A, out.smallest);
    bool fast = previous && may_leave(R, std::max(dot(wish, wish, n), dot(previous, previous, n)));
    if (far && !closer && !has_tip) return unconstrained_command(R, wish, lost, weak, out);
    limits.bounds(q, dt, approach, previous, ws.bounds);
    out.outside = ws.bounds.outside, ws.barrier.number = 0;
    double bound = closer ? approach_bound(out.smallest, ws.slope, limits.acceleration.data(), n, dt) : INF;
    if (bound < INF) ws.barrier.append(ws.slope, -bound, n);
    bool fits_all = !ws.barrier.number || dot(ws.slope, wish, n) >= -bound, near_wall = false;
    int tip_cause = -1, own_rows = ws.barrier.number;
    if (has_tip) {
      limits.tip.at(q, n, dt, limits.acceleration.data(), previous, ws.tips), ws.tips.clear = given.clear;
      if (limits.tip.rows(ws.tips, wish, n, 0.0, ws.barrier, &near_wall))
        fits_all = false, tip_cause = near_wall ? POSITION : VELOCITY;
      ws.barrier.number = own_rows;
    }
    fits_all = fits_all && ws.bounds.admit(wish, n);
    if (fits_all && !fast) return ws.bounds.clip(wish, n, wish), unconstrained_command(R, wish, lost, weak, out);
    // the part that drives is slowed down to what null-space motion makes no room for
    std::copy(wish, wish + n, asked);
    if (driven == s) across(b, Y, s, n, drive);
    else {
      double along[MAX], parts[MAX] = {};
      times(D, b, driven, s, along), across(along, D, driven, s, parts), across(parts, Y, s, n, drive);
    }
    double fastest = 0.0;
    for (int j = 0; j < n; j++)
      rest[j] = wish[j] - drive[j], fastest = std::max(fastest, std::abs(drive[j]) / limits.velocity[j]);
    double factor = 1.0;
    if (fastest > 1.0) {
      double left = INF;
      for (int j = 0; j < n; j++) {
        double size = std::abs(drive[j]), room = limits.velocity[j] - (drive[j] > 0.0 ? rest[j] : -rest[j]);
        if (size > ROUNDING) left = std::min(left, room / size);
      }
      factor = std::min(1.0, std::max(1.0 / fastest, left));
    }
    double toward = ws.barrier.number ? -factor * dot(ws.slope, drive, n) : 0.0;
    if (toward > 0.0) factor *= std::min(1.0, std::max(0.0, (dot(ws.slope, rest, n) + bound) / toward));
    for (int j = 0; j < n; j++) drive[j] *= factor, wish[j] = rest[j] + drive[j];
    double braking = fast && 0 < driven && driven < s ? braking_share(D, driven, wish, previous, *vjp) : 1.0;
    if (braking < 1.0) {
      fits_all = false, tip_cause = tip_cause < 0 ? ACCELERATION : tip_cause;
      for (int j = 0; j < n; j++) wish[j] = rest[j] + braking * drive[j];
    }
    if (fits_all) return ws.bounds.clip(asked, n, asked), unconstrained_command(R, asked, lost, weak, out);
    metric(ws, R, D, driven, b, lambda, dt, slide);
    if (!within(ws, wish, has_tip, out.velocity)) return false;
    return bounded(ws, R, basis, rank, asked, tip_cause, lost, weak, out);
  }

  // ---- what slows the law down, as law.py has it ----

  bool may_leave(const double* A, double square) const {
    double bend = std::sqrt(n * dot(A, A, s * n)) * square;
    return bend * square > 8.0 * ASIDE * limits.weakest * limits.weakest;
  }

  double braking_share(const double* D, int driven, const double* wish, const double* previous, const Vjp& vjp) const {
    double share = 1.0, W[MAX * MAX], slope[MAX], bend[MAX], along[MAX], parts[MAX];
    for (int which = 0; which < 2; which++) {
      const double* u = which ? previous : wish;
      double time = limits.stopping_time(u);
      for (int i = 0; i < s; i++) {
        std::fill(W, W + s * n, 0.0), std::copy(u, u + n, W + i * n);
        vjp(W, slope), bend[i] = dot(slope, u, n);
      }
      times(D, bend, driven, s, along), across(along, D, driven, s, parts);
      for (int i = 0; i < s; i++) bend[i] -= parts[i];
      double aside = 0.125 * time * time * std::sqrt(dot(bend, bend, s));
      if (aside > ASIDE) share = std::min(share, std::pow(ASIDE / aside, which ? 1.0 : 0.25));
    }
    return share;
  }

  // ---- before bounds ----

  // c of b - c, see `Law._with_bend`
  void straighten(Workspace& ws, const double* q, double dt, const double* A, const double* u, const Given& given,
                  Outcome& out) const {
    double x[MAX], speed = std::sqrt(dot(u, u, n));
    if (speed == 0.0) return;
    if (given.bend) std::copy(given.bend, given.bend + s, out.bend);
    else {
      for (int j = 0; j < n; j++) x[j] = q[j] + 0.5 * dt * u[j];
      rows.at(x, n, ws.ahead, ws.W);
      for (int i = 0; i < s * n; i++) ws.W[i] -= A[i];
      times(ws.W, u, s, n, out.bend);
    }
    double size = std::sqrt(dot(out.bend, out.bend, s)), most = 0.5 * STABLE_SLOPE * out.smallest * speed;
    if (size > most)
      for (int i = 0; i < s; i++) out.bend[i] *= most / size;
  }

  const Svd& near_singularity(Workspace& ws, const double* q, const double* A, const double* R, const double* D,
                              int driven, double dt, const Vjp& vjp, LazySvd& svd_of_A, Outcome& out,
                              double& lambda) const {
    Svd& svd = R == A ? svd_of_A() : ws.of_rows;
    if (R != A) svd.of(R, s, n);
    const Svd& own = svd_of_A();
    out.mu = out.smallest = 0.0;
    if (s <= n) {
      out.mu = 1.0, out.smallest = own.sigma[s - 1];
      for (int i = 0; i < s; i++) out.mu *= own.sigma[i];
    }
    double least = s <= n ? svd.sigma[s - 1] : 0.0, ratio = least / threshold;
    double share = std::max(0.0, 1.0 - ratio * ratio);
    seed(q, out.smallest, ws.w);
    double square = pressed_damping(svd, out.b, dt, vjp), scale = share * share * square;
    gram(R, s, n, ws.G);
    for (int i = 0; i < s; i++)
      for (int k = 0; k < s; k++) {
        double P = driven == s && i == k ? 1.0 : 0.0;
        if (driven < s)
          for (int d = 0; d < driven; d++) P += D[d * s + i] * D[d * s + k];
        ws.G[i * s + k] += scale * (HELD * HELD * (i == k ? 1.0 : 0.0) + (1.0 - HELD * HELD) * P);
      }
    std::copy(R, R + s * n, ws.Y);
    if (!solve_definite(ws.G, s, ws.Y, n)) std::fill(ws.Y, ws.Y + s * n, 0.0);
    double moved[MAX], free[MAX], within[MAX];
    across(out.b, ws.Y, s, n, out.task), times(R, ws.w, s, n, moved), across(moved, ws.Y, s, n, free);
    for (int j = 0; j < n; j++) free[j] = ws.w[j] - free[j];
    times(svd.V, free, svd.rank, n, within), across(within, svd.V, svd.rank, n, out.escape);
    for (int j = 0; j < n; j++) out.null[j] = free[j] - out.escape[j];
    double length = std::sqrt(dot(out.escape, out.escape, n)), wide = least / (ESCAPE_WIDTH * threshold);
    double fade = std::max(0.0, 1.0 - wide * wide), fastest = ESCAPE_SPEED * fade * fade;
    if (length > fastest)
      for (int j = 0; j < n; j++) out.escape[j] *= fastest / length;
    lambda = share * std::sqrt(square);
    return svd;
  }

  double pressed_damping(const Svd& svd, const double* b, double dt, const Vjp& vjp) const {
    double square = damping * damping, pressed[MAX] = {}, slope[MAX], along[MAX] = {}, W[MAX * MAX];
    bool any = false;
    int k = svd.k;
    for (int i = 0; i < k; i++)
      if (svd.sigma[i] < threshold && (s <= n || i < svd.rank)) add(pressed, dot(b, svd.U + i * s, s), svd.U + i * s, s);
    for (int i = 0; i < s; i++) any = any || pressed[i] != 0.0;
    if (!any) return square;
    auto outer = [this](const double* u, const double* v, double* W) {
      for (int i = 0; i < s; i++)
        for (int j = 0; j < n; j++) W[i * n + j] = u[i] * v[j];
    };
    double pressing = 1.0, total = 0.0;  // at the singularity itself
    if (svd.rank == k) {
      outer(svd.U + (k - 1) * s, svd.V + (k - 1) * n, W), vjp(W, slope);
      for (int i = 0; i < k; i++)
        add(along, dot(b, svd.U + i * s, s) * svd.sigma[i] / (svd.sigma[i] * svd.sigma[i] + square), svd.V + i * n, n);
      double size = std::sqrt(dot(slope, slope, n) * dot(along, along, n));
      pressing = size > 0.0 ? -dot(slope, along, n) / size : 0.0;
    }
    if (pressing <= 0.0) return square;
    for (int j = 0; j < n; j++) {
      double unit[MAX] = {};
      unit[j] = 1.0, outer(pressed, unit, W), vjp(W, slope), total += dot(slope, slope, n);
    }
    return square + pressing * std::max(0.0, dt / STABLE_SLOPE * std::sqrt(total) - square);
  }

  void seed(const double* q, double smallest, double* w) const {
    double speed = std::sqrt(dot(w, w, n)), least = SEED_SPEED * (1.0 - smallest / (SEED_SHARE * threshold));
    if (0.0 < speed && speed < least)
      for (int j = 0; j < n; j++) w[j] *= least / speed;
    if (ascends && smallest <= SINGULAR_RATIO && limits.given) limits.freer_sense(q, w);
  }

  // ---- within bounds ----

  // W of the metric 1 + W^T W
  void metric(Workspace& ws, const double* A, const double* D, int driven, const double* b, double lambda, double dt,
              double slide) const {
    double* W = ws.W;
    for (int i = 0; i < s * n; i++) W[i] = A[i] / ACROSS;
    if (driven) {
      double along[MAX], row[MAX], d[MAX], span = ACROSS, speed = std::hypot(ALONG, lambda);
      if (driven == s) std::copy(b, b + s, along);
      else times(D, b, driven, s, along);
      double length = std::sqrt(dot(along, along, driven));
      if (slide > 0.0) {
        double blur = std::max(damping, std::sqrt(dt / STABLE_SLOPE * std::sqrt(dot(b, b, s))));
        span += slide * (blur - span), speed += slide * (blur - speed);
        for (int r = 0; r < driven; r++) {
          double unit[MAX] = {};
          unit[r] = 1.0;
          const double* direction = driven == s ? unit : D + r * s;
          across(direction, A, s, n, row);
          for (int i = 0; i < s; i++) add(W + i * n, direction[i] * (1.0 / span - 1.0 / ACROSS), row, n);
        }
      }
      if (length > AT_GOAL) {
        if (driven == s) std::copy(along, along + s, d);
        else across(along, D, driven, s, d);
        for (int i = 0; i < s; i++) d[i] /= length;
        across(d, A, s, n, row);
        for (int i = 0; i < s; i++) add(W + i * n, d[i] * (1.0 / speed - 1.0 / span), row, n);
      }
    }
    ws.program.factor(W, s, n);
  }

  // the solution of the program, with the rows of frames that it needs
  bool within(Workspace& ws, const double* wish, bool has_tip, double* u) const {
    bool found = false;
    if (has_tip) {
      std::copy(wish, wish + n, u);
      for (int round = 0; round < MOST_ROWS; round++) {
        bool broken = limits.tip.rows(ws.tips, u, n, ROUNDED, ws.barrier);
        if (!broken && found) break;
        if (ws.barrier.number == MAX_ROWS) return false;
        found = true;
        if (!nearest_within(ws.program, wish, ws.bounds, ws.barrier.number ? &ws.barrier : nullptr, u)) break;
      }
    } else {
      nearest_within(ws.program, wish, ws.bounds, ws.barrier.number ? &ws.barrier : nullptr, u);
    }
    return true;
  }

  // whether u could approach the singularity too fast; then `slope` is the gradient of the smallest singular value
  bool approaches(Workspace& ws, const double* R, const double* u, double dt, const Vjp& vjp,
                  LazySvd& svd_of_A, double smallest) const {
    if (!damped || s > n || smallest <= SINGULAR_RATIO) return false;
    if (!limits.may_approach(dot(u, u, n), dot(R, R, s * n), smallest, dt)) return false;
    const Svd& svd = svd_of_A();
    for (int i = 0; i < s; i++)
      for (int j = 0; j < n; j++) ws.W[i * n + j] = svd.U[(s - 1) * s + i] * svd.V[(s - 1) * n + j];
    vjp(ws.W, ws.slope);
    return true;
  }

  // ---- what was done ----

  double progress(const double* A, const Outcome& out, const double* u) const {
    const double* b = out.b;
    double square = dot(b, b, s), moved[MAX];
    if (!(square > AT_GOAL * AT_GOAL)) return 1.0;
    times(A, u, s, n, moved), add(moved, 1.0, out.bend, s);
    return dot(b, moved, s) / square;
  }

  bool is_lost(const double* A, const Outcome& out) const {
    if (!out.near) return false;
    if (s > n) return progress(A, out, out.task) < SCALED_BELOW;
    double largest = 0.0;
    for (int i = 0; i < s * n; i++) largest = std::max(largest, std::abs(A[i]));
    return out.smallest <= SINGULAR_RATIO * largest;
  }

  static int status_of(const Outcome& out, bool lost, bool weak, bool changed, double scale, int cause, bool fits) {
    if (out.outside > 0.0) return OUTSIDE_LIMITS;
    if (lost) return SINGULAR;
    if (out.progress < STALLED_BELOW && (weak || changed) && cause != VELOCITY && cause != ACCELERATION) return STALLED;
    if (scale < SCALED_BELOW) return cause < 0 ? DAMPED : POSITION_LIMITED + cause;
    if (weak) return DAMPED;
    return !changed ? OK : fits ? NULL_SCALED : REROUTED;
  }

  bool unconstrained_command(const double* A, const double* wish, bool lost, bool weak, Outcome& out) const {
    std::copy(wish, wish + n, out.velocity);
    out.progress = out.near ? progress(A, out, wish) : 1.0;
    out.status = status_of(out, lost, weak, false, 1.0, -1, true);
    return true;
  }

  bool bounded(Workspace& ws, const double* A, const double* basis, int rank, const double* asked, int tip_cause,
               bool lost, bool weak, Outcome& out) const {
    const double* u = out.velocity;
    double moved[MAX], null[MAX], task[MAX];
    bool fits = ws.bounds.admit(out.task, n);
    double before = out.near ? progress(A, out, out.task) : 1.0, square = dot(out.null, out.null, n);
    if (out.near) times(basis, u, rank, n, moved);
    else times(A, u, s, n, moved);
    across(moved, basis, rank, n, null);
    for (int j = 0; j < n; j++) null[j] = u[j] - null[j], task[j] = u[j] - null[j];
    if (out.near) {
      double share = dot(u, out.escape, n) / std::max(dot(out.escape, out.escape, n), 1e-300);
      share = std::min(1.0, std::max(0.0, share));
      for (int j = 0; j < n; j++) out.escape[j] *= share, task[j] -= out.escape[j];
    }
    auto held = [](double x) { return std::min(1.0, std::max(0.0, x)); };
    out.null_scale = square > AT_GOAL * AT_GOAL ? held(dot(out.null, null, n) / square) : 1.0;
    std::copy(null, null + n, out.null), std::copy(task, task + n, out.task);
    out.progress = progress(A, out, u);
    out.task_scale = before > 0.0 ? held(out.progress / before) : 1.0;
    int cause;
    ws.bounds.binding(u, asked, n, out.joint, cause);
    out.status = status_of(out, lost, weak, true, out.task_scale, out.joint < 0 ? tip_cause : cause, fits);
    return true;
  }
};

// as `next_slide`
inline double next_slide(double slide, const Outcome& out, double dt) {
  if (std::sqrt(dot(out.b, out.b, out.s)) <= NEARBY || out.progress > GOING_ON)
    return std::max(0.0, slide - std::max(SOME, slide) * dt / KEEPING_AFTER);
  bool slows = out.progress < SLIDING_BELOW && SINGULAR <= out.status && out.status <= POSITION_LIMITED;
  if (slows && slide < SOME) return std::min(SOME, slide + SOME * dt / SLIDING_AFTER);
  return out.status == STALLED ? std::min(1.0, slide + dt / STALLED_AFTER) : slide;
}
