// The law for Python: a controller's description comes in as plain numbers, commands and rollouts go out.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>
#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#include <numpy/arrayobject.h>

#include <atomic>
#include <thread>

#include "law.hpp"

namespace nb = nanobind;
using Numbers = std::vector<double>;

template <class T> T get(const nb::dict& d, const char* key) { return nb::cast<T>(d[key]); }

static V3 vector_of(const Numbers& x) { return {x.at(0), x.at(1), x.at(2)}; }
static M3 matrix_of(const Numbers& x) {
  M3 out;
  std::copy_n(x.begin(), 9, out.m);
  return out;
}

static Chain chain_of(const nb::dict& d) {
  Chain chain;
  for (nb::handle item : get<nb::list>(d, "joints")) {
    nb::dict j = nb::cast<nb::dict>(item);
    chain.joints.push_back({matrix_of(get<Numbers>(j, "rotation")), vector_of(get<Numbers>(j, "translation")),
                            get<bool>(j, "slides"), get<int>(j, "column"), get<double>(j, "factor"),
                            get<double>(j, "offset")});
  }
  chain.R = matrix_of(get<Numbers>(d, "rotation")), chain.p = vector_of(get<Numbers>(d, "translation"));
  return chain;
}

static Policy policy_of(const nb::dict& d) {
  static const char* kinds[] = {"zero", "attractor", "avoidance", "ascent", "room", "sum"};
  Policy policy;
  auto kind = get<std::string>(d, "kind");
  for (int i = 0; i < 6; i++)
    if (kind == kinds[i]) policy.kind = Policy::Kind(i);
  policy.gain = get<double>(d, "gain"), policy.max_speed = get<double>(d, "max_speed");
  policy.enough = get<double>(d, "enough"), policy.logarithmic = get<bool>(d, "logarithmic");
  auto columns = get<std::vector<Numbers>>(d, "columns");
  columns.resize(4);
  policy.first = columns[0], policy.second = columns[1], policy.third = columns[2], policy.fourth = columns[3];
  policy.weights = get<Numbers>(d, "weights");
  for (nb::handle part : get<nb::list>(d, "parts")) policy.parts.push_back(policy_of(nb::cast<nb::dict>(part)));
  return policy;
}

// a workspace of this thread; another one for a call within a call
struct Lease {
  static thread_local std::vector<std::unique_ptr<Workspace>> idle;
  std::unique_ptr<Workspace> ws;
  Lease() {
    if (idle.empty()) ws.reset(new Workspace);
    else ws = std::move(idle.back()), idle.pop_back();
  }
  ~Lease() { idle.push_back(std::move(ws)); }
};
thread_local std::vector<std::unique_ptr<Workspace>> Lease::idle;

static PyObject* array_of(const double* values, npy_intp n) {
  PyObject* out = PyArray_SimpleNew(1, &n, NPY_DOUBLE);
  if (out && n) std::memcpy(PyArray_DATA((PyArrayObject*)out), values, n * sizeof(double));
  return out;
}

// the numbers of an array as large as expected; null if it is another thing
static double* numbers_of(nb::handle h, npy_intp size, int dimensions = 0) {
  if (!PyArray_Check(h.ptr())) return nullptr;
  auto* a = (PyArrayObject*)h.ptr();
  bool plain = PyArray_TYPE(a) == NPY_DOUBLE && PyArray_ISCARRAY_RO(a) && PyArray_SIZE(a) == size;
  if (dimensions && PyArray_NDIM(a) != dimensions) return nullptr;
  return plain ? (double*)PyArray_DATA(a) : nullptr;
}

class Engine {
  Law law;
  nb::object command_type;
  std::vector<nb::object> statuses;
  std::shared_ptr<const std::vector<Approach>> approach;
  double approach_dt = 0.0, farthest_given = INF;
  Numbers farthest;

  void prepare(double dt) {
    if (dt == approach_dt) return;
    approach = std::make_shared<std::vector<Approach>>(law.limits.approaches(dt)), approach_dt = dt;
  }

 public:
  Engine(const nb::dict& d, nb::object command, nb::list names) : command_type(command) {
    for (nb::handle name : names) statuses.push_back(nb::borrow(name));
    law.n = get<int>(d, "n"), law.s = get<int>(d, "s");
    law.damped = get<bool>(d, "damped"), law.ascends = get<bool>(d, "ascends");
    law.threshold = get<double>(d, "threshold"), law.damping = get<double>(d, "damping");
    if (law.n < 1 || law.s < 1 || law.n > MAX || law.s > MAX) throw nb::value_error("too many rows or joints");
    law.rows.s = law.s;
    if (!d["rows"].is_none()) {
      nb::dict r = get<nb::dict>(d, "rows");
      law.known = true, law.rows.chain = chain_of(get<nb::dict>(r, "chain"));
      law.rows.own_axes = get<bool>(r, "own_axes"), law.rows.constant = get<Numbers>(r, "constant");
      law.rows.slopes = get<Numbers>(r, "slopes"), law.rows.by_place = !law.rows.slopes.empty();
      for (nb::handle item : get<nb::list>(r, "free")) {
        nb::dict f = nb::cast<nb::dict>(item);
        FreeRow row;
        auto constant = get<Numbers>(f, "constant"), by_place = get<Numbers>(f, "by_place"), b = get<Numbers>(f, "b");
        std::copy_n(constant.begin(), 3, row.constant), std::copy_n(by_place.begin(), 9, row.by_place);
        std::copy_n(b.begin(), 3, row.b), row.h = get<double>(f, "h"), row.share = get<Numbers>(f, "share");
        law.rows.free.push_back(row);
      }
    }
    if (!d["task"].is_none()) {
      nb::dict t = get<nb::dict>(d, "task");
      auto kind = get<std::string>(t, "kind");
      law.task.kind = kind == "hold" ? Task::HOLD : kind == "place" ? Task::PLACE : Task::POSE;
      law.task.gain = get<double>(t, "gain"), law.task.max_speed = get<double>(t, "max_speed");
      law.task.goal = get<Numbers>(t, "goal"), law.task.selection = get<Numbers>(t, "selection");
      if (law.task.kind == Task::POSE) {
        law.task.place = vector_of(get<Numbers>(t, "place")), law.task.given = vector_of(get<Numbers>(t, "given"));
        law.task.rotation = matrix_of(get<Numbers>(t, "rotation"));
      }
    }
    law.task.slides = get<bool>(d, "slides");
    if (!d["policy"].is_none()) law.policy = policy_of(get<nb::dict>(d, "policy")), law.has_policy = true;
    law.limits.n = law.n;
    if (d["limits"].is_none()) return;
    nb::dict l = get<nb::dict>(d, "limits");
    law.limits.given = true, law.limits.lower = get<Numbers>(l, "lower"), law.limits.upper = get<Numbers>(l, "upper");
    law.limits.velocity = get<Numbers>(l, "velocity"), law.limits.acceleration = get<Numbers>(l, "acceleration");
    for (double a : law.limits.acceleration) law.limits.weakest = std::min(law.limits.weakest, a);
    law.limits.tip.speed = get<double>(l, "tip_speed"), law.limits.tip.walls = get<Numbers>(l, "walls");
    for (nb::handle frame : get<nb::list>(l, "frames")) law.limits.tip.frames.push_back(chain_of(nb::cast<nb::dict>(frame)));
    law.limits.has_tip = !law.limits.tip.frames.empty();
    farthest = get<Numbers>(l, "farthest");
  }

  // None where Python has to do the step: input that is none, or a case that the engine leaves to it
  nb::object command(nb::handle q, double dt, nb::handle previous, double slide, nb::handle b, nb::handle E, nb::handle D,
                     nb::handle w, nb::handle A, nb::handle rates, nb::handle bend, nb::handle clear) {
    int n = law.n, s = law.s;
    const double *posture = numbers_of(q, n, 1), *before = numbers_of(previous, n, 1);
    if (!posture || (!previous.is_none() && !before)) return nb::none();
    Given given;
    given.b = numbers_of(b, s), given.E = numbers_of(E, s * n), given.w = numbers_of(w, n);
    given.bend = numbers_of(bend, s);
    given.A = numbers_of(A, s * n);
    if (!D.is_none()) {
      given.driven = PyArray_Check(D.ptr()) ? PyArray_SIZE((PyArrayObject*)D.ptr()) / s : 0;
      given.D = numbers_of(D, given.driven * s);
      if (given.driven && !given.D) return nb::none();
    }
    bool missing = (!b.is_none() && !given.b) || (!E.is_none() && !given.E) || (!w.is_none() && !given.w) ||
                   (!law.known && (!given.A || (before && !given.bend))) ||
                   (law.task.kind == Task::GIVEN && !given.b) || (!law.has_policy && !given.w);
    if (missing) return nb::none();
    Vjp callback = [&rates, n, s](const double* W, double* out) {
      npy_intp shape[2] = {s, n};
      nb::object weights = nb::steal(PyArray_SimpleNew(2, shape, NPY_DOUBLE));
      std::memcpy(PyArray_DATA((PyArrayObject*)weights.ptr()), W, s * n * sizeof(double));
      nb::object answer = nb::steal(PyArray_FROM_OTF(rates(weights).ptr(), NPY_DOUBLE, NPY_ARRAY_IN_ARRAY));
      if (!answer.is_valid()) throw nb::python_error();
      const double* gradient = numbers_of(answer, n);
      if (!gradient) throw nb::value_error("a vector-Jacobian product of another size");
      std::copy(gradient, gradient + n, out);
    };
    if (!law.known) given.rates = &callback;
    Cuts cuts = [&clear, n](const double* u, Barrier& rows) {
      nb::object answer = clear(nb::steal(array_of(u, n)));
      if (answer.is_none()) return;
      nb::object G = answer[0], bound = answer[1];
      npy_intp number = PyArray_Check(bound.ptr()) ? PyArray_SIZE((PyArrayObject*)bound.ptr()) : 0;
      const double *g = numbers_of(G, number * n), *least = numbers_of(bound, number);
      if (!g || !least) throw nb::value_error("rows of another size");
      for (npy_intp r = 0; r < number; r++) rows.append(g + r * n, least[r], n);
    };
    if (!clear.is_none()) given.clear = &cuts;
    if (law.limits.given) prepare(dt);
    auto approaches = approach;
    Lease lease;
    Outcome out;
    const Approach* constants = approaches ? approaches->data() : nullptr;
    if (!law.command(*lease.ws, posture, dt, constants, before, slide, given, out)) return nb::none();
    return made(out);
  }

  // a step of which the engine knows everything
  nb::object step(nb::handle q, double dt, nb::handle previous, double slide) {
    const double *posture = numbers_of(q, law.n, 1), *before = numbers_of(previous, law.n, 1);
    if (!posture || (!previous.is_none() && !before)) return nb::none();
    if (law.limits.given) prepare(dt);
    Lease lease;
    Outcome out;
    const Approach* constants = approach ? approach->data() : nullptr;
    slide = law.task.slides ? slide : 0.0;
    if (!law.command(*lease.ws, posture, dt, constants, before, slide, Given(), out)) return nb::none();
    return made(out);
  }

  // The next samples of runs as a ServoLoop in simulation makes them, one start a row; postures, velocities before and
  // slides go on in place. Writes into tables (starts, samples, ...); returns which starts Python has to do.
  std::vector<bool> roll(nb::handle q, nb::handle u, nb::handle slides, double dt, int samples, nb::handle postures,
                         nb::handle velocities, nb::handle numbers, int threads) {
    npy_intp n = law.n, k = PyArray_DIM((PyArrayObject*)q.ptr(), 0);
    double *x = numbers_of(q, k * n), *v = numbers_of(u, k * n), *slide = numbers_of(slides, k);
    double *to_q = numbers_of(postures, k * samples * n), *to_u = numbers_of(velocities, k * samples * n);
    double* to = numbers_of(numbers, k * samples * 3);  // manipulability, error of the task, status
    if (!(x && v && slide && to_q && to_u && to)) throw nb::value_error("tables of another size");
    prepare(dt);
    auto approaches = approach;
    std::vector<char> failed(k, 0);
    std::atomic<npy_intp> next{0};
    auto work = [&]() {
      Lease lease;
      for (npy_intp i = next++; i < k; i = next++) failed[i] = !run(*lease.ws, approaches->data(), x + i * n, v + i * n,
          slide[i], dt, samples, to_q + i * samples * n, to_u + i * samples * n, to + i * samples * 3);
    };
    {
      nb::gil_scoped_release release;
      std::vector<std::thread> crew;
      for (int i = 1; i < std::min<npy_intp>(threads, k); i++) crew.emplace_back(work);
      work();
      for (auto& thread : crew) thread.join();
    }
    return {failed.begin(), failed.end()};
  }

 private:
  nb::object made(const Outcome& out) const {
    auto* type = (PyTypeObject*)command_type.ptr();
    PyObject* fields[14] = {
        array_of(out.velocity, law.n), nb::object(statuses[out.status]).release().ptr(), PyFloat_FromDouble(out.mu),
        array_of(out.b, law.s), array_of(out.task, law.n), array_of(out.null, law.n),
        PyFloat_FromDouble(out.task_scale), PyFloat_FromDouble(out.null_scale), PyFloat_FromDouble(out.smallest),
        out.near ? array_of(out.escape, law.n) : nb::none().release().ptr(), PyFloat_FromDouble(out.progress),
        PyFloat_FromDouble(out.outside), PyLong_FromLong(out.joint), PyFloat_FromDouble(0.0)};
    PyObject* command = type->tp_alloc(type, 14);  // a named tuple is a tuple
    for (int i = 0; i < 14; i++) PyTuple_SET_ITEM(command, i, fields[i]);
    return nb::steal(command);
  }

  bool run(Workspace& ws, const Approach* approaches, double* q, double* u, double& slide, double dt, int samples,
           double* to_q, double* to_u, double* to) const {
    int n = law.n, s = law.s;
    Outcome out;
    for (int i = 0; i < samples; i++, to_q += n, to_u += n, to += 3) {
      for (int j = 0; j < n; j++)
        if (!(std::abs(q[j]) < farthest[j])) return false;
      if (!law.command(ws, q, dt, approaches, u, law.task.slides ? slide : 0.0, Given(), out)) return false;
      double left[MAX];
      law.task.displacement(law.rows, ws.here.J, n, left, nullptr);
      slide = next_slide(slide, out, dt);
      std::copy(q, q + n, to_q), std::copy(out.velocity, out.velocity + n, to_u);
      to[0] = out.mu, to[1] = std::sqrt(dot(left, left, s)), to[2] = out.status;
      for (int j = 0; j < n; j++) u[j] = out.velocity[j], q[j] += dt * u[j];
    }
    return true;
  }
};

NB_MODULE(_engine, m) {
  if (_import_array() < 0) throw nb::python_error();
  m.attr("LAW_VERSION") = LAW_VERSION;
  nb::class_<Engine>(m, "Engine")
      .def(nb::init<const nb::dict&, nb::object, nb::list>())
      .def("command", &Engine::command, nb::arg().none(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg().none(),
           nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg().none(),
           nb::arg().none())
      .def("step", &Engine::step, nb::arg().none(), nb::arg(), nb::arg().none(), nb::arg())
      .def("roll", &Engine::roll);
}
