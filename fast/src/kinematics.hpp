// Kinematics of one frame on a chain of joints, its rows and their derivative, as frame_kinematics.py has them.
#pragma once
#include <functional>
#include <vector>

#include "small_matrices.hpp"

struct V3 {
  double x, y, z;
};
inline V3 operator+(V3 a, V3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline V3 operator-(V3 a, V3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline V3 operator*(double f, V3 a) { return {f * a.x, f * a.y, f * a.z}; }
inline V3 cross(V3 a, V3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
inline double dot(V3 a, V3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

struct M3 {
  double m[9];
  V3 column(int i) const { return {m[i], m[3 + i], m[6 + i]}; }
};
inline V3 operator*(const M3& a, V3 v) {
  return {a.m[0] * v.x + a.m[1] * v.y + a.m[2] * v.z, a.m[3] * v.x + a.m[4] * v.y + a.m[5] * v.z,
          a.m[6] * v.x + a.m[7] * v.y + a.m[8] * v.z};
}
inline V3 turned_back(const M3& a, V3 v) { return {dot(a.column(0), v), dot(a.column(1), v), dot(a.column(2), v)}; }
inline M3 operator*(const M3& a, const M3& b) {
  M3 c;
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++)
      c.m[3 * i + j] = a.m[3 * i] * b.m[j] + a.m[3 * i + 1] * b.m[3 + j] + a.m[3 * i + 2] * b.m[6 + j];
  return c;
}

// weights (s x nv) -> sum_ij weights_ij dA_ij / dq_k
using Vjp = std::function<void(const double*, double*)>;

struct Joint {
  M3 R;  // placement on the joint before, turned so that every joint moves along its own z
  V3 p;
  bool slides;
  int column;  // of the robot's joints, whose position times the factor, plus the offset, is that of this one
  double factor, offset;
};

// columns of the Jacobian at the frame's origin, of the joints of the chain
struct Twists {
  V3 v[MAX], w[MAX], position;
  M3 rotation;
};

struct Chain {
  std::vector<Joint> joints;
  M3 R;  // the frame on the last joint
  V3 p;

  void at(const double* q, bool own_axes, Twists& out) const {
    V3 origins[MAX], o{0, 0, 0};
    M3 T{{1, 0, 0, 0, 1, 0, 0, 0, 1}};
    int n = joints.size();
    for (int j = 0; j < n; j++) {
      const Joint& joint = joints[j];
      double x = joint.factor * q[joint.column] + joint.offset;
      o = o + T * joint.p, T = T * joint.R;
      V3 z = T.column(2);
      if (joint.slides) {
        out.v[j] = z, out.w[j] = {0, 0, 0}, o = o + x * z;
      } else {
        out.w[j] = z, origins[j] = o;
        double c = std::cos(x), s = std::sin(x);
        for (int i = 0; i < 9; i += 3) {
          double a = T.m[i], b = T.m[i + 1];
          T.m[i] = c * a + s * b, T.m[i + 1] = c * b - s * a;
        }
      }
    }
    out.position = o = o + T * p, out.rotation = T * R;
    for (int j = 0; j < n; j++) {
      if (!joints[j].slides) out.v[j] = cross(out.w[j], o - origins[j]);
      if (own_axes) out.v[j] = turned_back(out.rotation, out.v[j]), out.w[j] = turned_back(out.rotation, out.w[j]);
    }
  }

  // rows (s x nv) of weights (s x 6) on the twist
  void rows(const Twists& J, const double* L, int s, int nv, double* A) const {
    std::fill(A, A + s * nv, 0.0);
    for (size_t j = 0; j < joints.size(); j++)
      for (int i = 0; i < s; i++) {
        const double* l = L + 6 * i;
        V3 v = J.v[j], w = J.w[j];
        double value = l[0] * v.x + l[1] * v.y + l[2] * v.z + l[3] * w.x + l[4] * w.y + l[5] * w.z;
        A[i * nv + joints[j].column] += joints[j].factor * value;
      }
  }

  // sum_ij weights_ij d(L J)_ij / dq_k, from the closed form of dJ/dq with sums over the joints above and below
  void vjp(const Twists& J, bool own_axes, const double* L, int s, int nv, const double* weights, double* out) const {
    std::fill(out, out + nv, 0.0);
    int n = joints.size();
    V3 mv[MAX], mw[MAX], before{0, 0, 0}, turning{0, 0, 0}, behind{0, 0, 0};
    for (int j = 0; j < n; j++) {
      double m[6] = {};
      for (int i = 0; i < s; i++) add(m, joints[j].factor * weights[i * nv + joints[j].column], L + 6 * i, 6);
      mv[j] = {m[0], m[1], m[2]}, mw[j] = {m[3], m[4], m[5]};
    }
    for (int k = 0; k < n; k++) {
      double g = dot(J.v[k], before) + (own_axes ? dot(J.w[k], turning) : 0.0);
      out[joints[k].column] += joints[k].factor * g;
      before = before + cross(mv[k], J.w[k]);
      if (own_axes) turning = turning + cross(mv[k], J.v[k]) + cross(mw[k], J.w[k]);
    }
    if (own_axes) return;
    for (int k = n - 1; k >= 0; k--) {
      behind = behind + cross(J.v[k], mv[k]) + cross(J.w[k], mw[k]);
      out[joints[k].column] += joints[k].factor * dot(J.w[k], behind);
    }
  }
};

// A row whose weights of v are made unit length, see PlaceWeights
struct FreeRow {
  double constant[3], by_place[9], b[3], h;
  std::vector<double> share;  // of Lambda's rows in it

  void at(V3 place, double* f, double* df) const {
    constexpr double ON_AXIS = 1e-5;
    double p[3] = {place.x, place.y, place.z}, y[3], along[3];
    times(by_place, p, 3, 3, y);
    for (int i = 0; i < 3; i++) y[i] += constant[i];
    across(y, by_place, 3, 3, along);
    double s = dot(y, y, 3), edge = s + ON_AXIS * ON_AXIS, size = std::sqrt(edge), turned = 1.0, rise = 1.0;
    bool helix = b[0] != 0.0 || b[1] != 0.0 || b[2] != 0.0;
    if (helix) size = std::sqrt(edge * (edge + h * h)), turned = -h, rise = 2.0 * edge + h * h;
    for (int i = 0; i < 3; i++) f[i] = (s * b[i] + turned * y[i]) / size;
    for (int i = 0; i < 3; i++)
      for (int j = 0; j < 3; j++) {
        double slope = helix ? 2.0 * b[i] * along[j] - h * by_place[3 * i + j] : by_place[3 * i + j];
        df[3 * i + j] = (slope - f[i] * rise * along[j] / size) / size;
      }
  }
};

// A = Lambda (T_0 + sum_k p_k T_k) J, with the frame's origin p
struct Rows {
  Chain chain;
  bool own_axes = false, by_place = false;
  int s = 0;
  std::vector<double> constant, slopes;  // Lambda T_0 (s x 6), Lambda T_k (s x 6 x 3)
  std::vector<FreeRow> free;

  struct At {
    Twists J;
    double L[6 * MAX], dL[18 * MAX];
  };

  void at(const double* q, int nv, At& here, double* A) const {
    chain.at(q, own_axes, here.J);
    std::copy(constant.begin(), constant.end(), here.L);
    if (by_place) {
      V3 p = here.J.position;
      std::copy(slopes.begin(), slopes.end(), here.dL);
      for (int i = 0; i < 6 * s; i++) here.L[i] += dot(V3{slopes[3 * i], slopes[3 * i + 1], slopes[3 * i + 2]}, p);
      for (const FreeRow& row : free) {
        double f[3], df[9];
        row.at(p, f, df);
        for (int i = 0; i < s; i++) add(here.L + 6 * i, row.share[i], f, 3), add(here.dL + 18 * i, row.share[i], df, 9);
      }
    }
    chain.rows(here.J, here.L, s, nv, A);
  }

  void vjp(const At& here, int nv, const double* weights, double* out) const {
    chain.vjp(here.J, own_axes, here.L, s, nv, weights, out);
    if (!by_place) return;
    double along[3] = {};
    for (size_t j = 0; j < chain.joints.size(); j++) {
      const Joint& joint = chain.joints[j];
      double twist[6] = {here.J.v[j].x, here.J.v[j].y, here.J.v[j].z, here.J.w[j].x, here.J.w[j].y, here.J.w[j].z};
      for (int i = 0; i < s; i++)
        for (int r = 0; r < 6; r++)
          add(along, joint.factor * weights[i * nv + joint.column] * twist[r], here.dL + 18 * i + 3 * r, 3);
    }
    for (size_t j = 0; j < chain.joints.size(); j++)
      out[chain.joints[j].column] += chain.joints[j].factor * dot(here.J.v[j], V3{along[0], along[1], along[2]});
  }
};
