// Python module tauext._core: checks shapes and forwards. The interpreter lock is released in every call over many samples.
#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <limits>

#include "arrays.hpp"
#include "chain/motion.hpp"
#include "fit/regressors.hpp"
#include "lstm_gradient.hpp"
#include "stages/estimates.hpp"
#include "stages/observation.hpp"
#include "tauext/bundle.hpp"

namespace nb = nanobind;
using namespace tauext;
using namespace tauext::bindings;

namespace {

// Rows of the windows, with the inputs that they refer to.
struct PythonWindows {
  std::vector<LstmInput> inputs;
  WindowRows rows;

  PythonWindows(const Array<float, 2>& features, int stride, int length, const std::vector<std::pair<int, int>>& map) {
    for (const auto& [column, lag] : map) inputs.push_back({column, lag});
    rows = {features.data(), static_cast<std::int64_t>(features.shape(0)), static_cast<int>(features.shape(1)), stride,
            length, inputs};
  }
};

std::vector<std::pair<int, int>> input_pairs(const std::vector<LstmInput>& inputs) {
  std::vector<std::pair<int, int>> pairs;
  for (const LstmInput& input : inputs) pairs.emplace_back(input.column, input.lag);
  return pairs;
}

std::vector<std::string> units(const Bundle& bundle, std::string (Bundle::*unit)(int) const) {
  std::vector<std::string> out;
  for (int j = 0; j < bundle.joints(); ++j) out.push_back((bundle.*unit)(j));
  return out;
}

template <class T>
void bind_list(nb::class_<Bundle>& cls, const char* name, std::vector<T> Bundle::*member, const char* doc) {
  cls.def_prop_rw(
      name, [member](const Bundle& b) { return b.*member; },
      [member](Bundle& b, std::vector<T> values) { b.*member = std::move(values); }, doc);
}

// sliding_limit_nm, near_stiction_limit_nm and hold_s of the collision; the same with the prefix contact_.
void bind_level(nb::class_<Bundle>& cls, const std::string& prefix, Level Limits::*level) {
  const std::string what = prefix.empty() ? "collision" : "contact";
  const auto limit = [&what](const std::string& where) {
    return "Limit of |tau_ext| per joint for a " + what + " " + where +
           ", [N m]; in usual motion if there is an error scale.";
  };
  cls.def_prop_rw(
         (prefix + "sliding_limit_nm").c_str(), [level](const Bundle& b) { return (b.limits.*level).sliding_nm; },
         [level](Bundle& b, std::vector<double> v) { (b.limits.*level).sliding_nm = std::move(v); },
         limit("while it slides").c_str())
      .def_prop_rw(
          (prefix + "near_stiction_limit_nm").c_str(),
          [level](const Bundle& b) { return (b.limits.*level).near_stiction_nm; },
          [level](Bundle& b, std::vector<double> v) { (b.limits.*level).near_stiction_nm = std::move(v); },
          limit("near stiction").c_str())
      .def_prop_rw(
          (prefix + "hold_s").c_str(), [level](const Bundle& b) { return (b.limits.*level).hold_s; },
          [level](Bundle& b, double v) { (b.limits.*level).hold_s = v; },
          ("Time above its limit after which a joint raises a " + what + ", [s]; 0: at the first sample.").c_str());
}

void bind_tree(nb::module_& m) {
  nb::enum_<JointType>(m, "JointType", "Whether a joint rotates or translates its link.")
      .value("revolute", JointType::revolute)
      .value("prismatic", JointType::prismatic);
  nb::class_<Link>(m, "Link",
      "A moving link and the joint that carries it; the joint axis is the link frame's +z axis.")
      .def(nb::init<>())
      .def_rw("joint_name", &Link::joint_name, "Name of the joint in the robot file.")
      .def_rw("parent", &Link::parent, "Index of the parent link; -1: the base.")
      .def_rw("type", &Link::type, "Type of the joint.")
      .def_rw("rotation", &Link::rotation, "Parent from link at q = 0, row-major.")
      .def_rw("translation", &Link::translation, "Joint origin in the parent's frame, [m].")
      .def_rw("mass", &Link::mass, "[kg].")
      .def_rw("com", &Link::com, "Centre of mass in the link frame, [m].")
      .def_rw("inertia", &Link::inertia, "About the centre of mass, link axes: xx, yy, zz, xy, xz, yz, [kg m^2].")
      .def_rw("rotor_inertia", &Link::rotor_inertia, "Motor inertia times gear ratio squared, [kg m^2] or [kg].");
  nb::class_<Tree>(m, "Tree", "Kinematic tree of 1 to 32 moving joints, in any order.")
      .def(nb::init<std::vector<Link>, std::array<double, 3>>(), nb::arg("links"), nb::arg("gravity"))
      .def_prop_ro("size", &Tree::size, "Number of joints.")
      .def_prop_ro("links", [](const Tree& t) { return t.links(); }, "Links, as passed to the constructor.")
      .def_prop_ro("gravity", &Tree::gravity, "Acceleration of free fall in the base frame, [m/s^2].")
      .def(
          "momentum",
          [](const Tree& tree, const Array<double, 2>& q, const Array<double, 2>& dq) {
            const std::size_t N = q.shape(0), n = static_cast<std::size_t>(tree.size());
            if (q.shape(1) != n || dq.shape(1) != n || dq.shape(0) != N)
              throw Error("q and dq must have the shape (samples, " + std::to_string(n) + ")");
            std::vector<double> p(N * n), beta(N * n);
            {
              nb::gil_scoped_release released;
              for (std::size_t k = 0; k < N; ++k)
                tree.momentum(std::span(q.data() + k * n, n), std::span(dq.data() + k * n, n),
                              std::span(p).subspan(k * n, n), std::span(beta).subspan(k * n, n));
            }
            return std::pair(to_numpy(std::move(p), {N, n}), to_numpy(std::move(beta), {N, n}));
          },
          nb::arg("q"), nb::arg("dq"),
          "Generalised momentum p = M dq [N m s] and beta = g - C^T dq [N m] of states (samples, n).");
}

void bind_observer(nb::module_& m) {
  nb::enum_<TorqueTiming>(m, "TorqueTiming", "Meaning of a torque sample.")
      .value("held", TorqueTiming::held, "Acts from its time stamp to the next one: a commanded torque.")
      .value("instant", TorqueTiming::instant, "Measured at its time stamp.")
      .value("averaged", TorqueTiming::averaged, "Mean over the step that ends at its time stamp.");
  nb::enum_<ResidualMethod>(m, "ResidualMethod", "Definition of r; see comparison_residuals.hpp.")
      .value("momentum", ResidualMethod::momentum)
      .value("direct", ResidualMethod::direct)
      .value("velocity", ResidualMethod::velocity)
      .value("energy", ResidualMethod::energy);
  nb::class_<ObserverSettings>(m, "ObserverSettings",
                               "Gain K0 [1/s], torque timing, sample period [ns], network stride; residual method and the rates "
                               "of its filters [1/s], 0: none; torque constants, factors on tau, empty: none.")
      .def(
          "__init__",
          [](ObserverSettings* s, double gain_per_s, TorqueTiming timing, std::int64_t sample_period_ns,
             int network_stride, ResidualMethod method, double high_pass_per_s, double low_pass_per_s,
             std::vector<double> nm_per_unit) {
            new (s) ObserverSettings{gain_per_s, timing,          sample_period_ns, network_stride,
                                     method,     high_pass_per_s, low_pass_per_s,   std::move(nm_per_unit)};
          },
          nb::kw_only(), nb::arg("gain_per_s"), nb::arg("timing"), nb::arg("sample_period_ns"),
          nb::arg("network_stride"), nb::arg("method") = ResidualMethod::momentum, nb::arg("high_pass_per_s") = 0.0,
          nb::arg("low_pass_per_s") = 0.0, nb::arg("nm_per_unit") = std::vector<double>())
      .def_ro("gain_per_s", &ObserverSettings::gain_per_s)
      .def_ro("timing", &ObserverSettings::timing)
      .def_ro("sample_period_ns", &ObserverSettings::sample_period_ns)
      .def_ro("network_stride", &ObserverSettings::network_stride)
      .def_ro("method", &ObserverSettings::method)
      .def_ro("high_pass_per_s", &ObserverSettings::high_pass_per_s)
      .def_ro("low_pass_per_s", &ObserverSettings::low_pass_per_s)
      .def_ro("nm_per_unit", &ObserverSettings::nm_per_unit);
  nb::enum_<TermKind>(m, "TermKind", "Regressors of the prior; see settings.hpp.")
      .value("constant", TermKind::constant)
      .value("viscous", TermKind::viscous)
      .value("coulomb", TermKind::coulomb)
      .value("presliding", TermKind::presliding)
      .value("load", TermKind::load)
      .value("load_presliding", TermKind::load_presliding)
      .value("ripple", TermKind::ripple)
      .value("gravity", TermKind::gravity)
      .value("quadratic", TermKind::quadratic)
      .value("momentum", TermKind::momentum)
      .value("backlash", TermKind::backlash)
      .value("local_memory", TermKind::local_memory);
  nb::class_<Term>(m, "Term", "A regressor of the prior; settings.hpp defines a, b, c, form and speed for each kind.")
      .def(
          "__init__",
          [](Term* t, TermKind kind, int a, int b, int c, int form, double speed) {
            new (t) Term{kind, a, b, c, form, speed};
          },
          nb::arg("kind"), nb::arg("a") = 0, nb::arg("b") = 0, nb::arg("c") = 0, nb::arg("form") = 0,
          nb::arg("speed") = 0.0)
      .def_ro("kind", &Term::kind)
      .def_ro("a", &Term::a)
      .def_ro("b", &Term::b)
      .def_ro("c", &Term::c)
      .def_ro("form", &Term::form)
      .def_ro("speed", &Term::speed);
  nb::class_<FrictionTemperature>(m, "FrictionTemperature",
      "Friction as a function of the joint temperatures; see settings.hpp.")
      .def(nb::init<>())
      .def_rw("reference_c", &FrictionTemperature::reference_c)
      .def_rw("reach_k", &FrictionTemperature::reach_k)
      .def_rw("coulomb_per_10k", &FrictionTemperature::coulomb_per_10k)
      .def_rw("viscous_per_10k", &FrictionTemperature::viscous_per_10k);
  nb::class_<PriorSettings>(m, "PriorSettings",
      "Presliding widths [rad], terms with weights (joints, terms), corrected links; see settings.hpp.")
      .def(nb::init<>())
      .def_rw("widths_rad", &PriorSettings::widths_rad)
      .def_rw("branches", &PriorSettings::branches)
      .def_rw("terms", &PriorSettings::terms)
      .def_rw("weights", &PriorSettings::weights)
      .def_rw("corrected_links", &PriorSettings::corrected_links)
      .def_rw("most_load_nm", &PriorSettings::most_load_nm)
      .def_rw("temperature", &PriorSettings::temperature);
  nb::class_<Observation>(m, "Observation",
      "Residuals of a recording, and the place of its samples on the regular clock.")
      .def_ro("row_count", &Observation::row_count)
      .def_ro("held_rows", &Observation::held_rows)
      .def_ro("restarts", &Observation::restarts)
      .def_prop_ro(
          "residual",
          [](Observation& o) {
            const std::size_t N = o.row.size();
            return nb::ndarray<nb::numpy, double>(o.residual.data(), {N, N ? o.residual.size() / N : 0}, nb::handle());
          },
          nb::rv_policy::reference_internal)
      .def_prop_ro(
          "prior",
          [](Observation& o) {
            const std::size_t N = o.row.size();
            return nb::ndarray<nb::numpy, double>(o.prior.data(), {o.prior.empty() ? 0 : N, N ? o.prior.size() / N : 0}, nb::handle());
          },
          nb::rv_policy::reference_internal)
      .def_prop_ro(
          "presliding",
          [](Observation& o) {
            const std::size_t N = o.row.size();
            return nb::ndarray<nb::numpy, float>(o.presliding.data(), {N, N ? o.presliding.size() / N : 0}, nb::handle());
          },
          nb::rv_policy::reference_internal)
      .def_prop_ro(
          "row", [](Observation& o) { return nb::ndarray<nb::numpy, std::int64_t>(o.row.data(), {o.row.size()}, nb::handle()); },
          nb::rv_policy::reference_internal)
      .def_prop_ro(
          "stretch_begin",
          [](Observation& o) {
            return nb::ndarray<nb::numpy, std::int64_t>(o.stretch_begin.data(), {o.row.size()}, nb::handle());
          },
          nb::rv_policy::reference_internal)
      .def_prop_ro(
          "warm",
          [](Observation& o) { return nb::ndarray<nb::numpy, std::uint8_t>(o.warm.data(), {o.row.size()}, nb::handle()); },
          nb::rv_policy::reference_internal);
  m.def(
      "observe",
      [](const Tree& tree, const ObserverSettings& settings, const Array<std::int64_t, 1>& t_ns,
         const Array<double, 2>& q, const Array<double, 2>& dq, const Array<double, 2>& tau, const PriorSettings& prior,
         const Temperatures& temperature) {
        const RecordingView recording = view(t_ns, q, dq, tau, temperature);
        nb::gil_scoped_release released;
        return observe(tree, settings, prior, recording);
      },
      nb::arg("tree"), nb::arg("settings"), nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"), nb::arg("tau"),
      nb::arg("prior") = PriorSettings(), nb::arg("temperature") = nb::none(),
           "Residual of every sample of a recording, without the network.");
  m.def(
      "prior_regressors",
      [](const Tree& tree, const ObserverSettings& settings, const PriorSettings& prior,
         const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
         const Array<double, 2>& tau, const Array<std::int64_t, 1>& samples) {
        const RecordingView recording = view(t_ns, q, dq, tau);
        std::vector<double> out;
        {
          nb::gil_scoped_release released;
          out = prior_regressors(tree, settings, prior, recording, span_of(samples));
        }
        return to_numpy(std::move(out), {samples.shape(0), prior.terms.size()});
      },
      nb::arg("tree"), nb::arg("settings"), nb::arg("prior"), nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"),
      nb::arg("tau"), nb::arg("samples"), "Terms of the prior, each filtered like the observer: (samples, terms).");
  nb::class_<LinkRegressors>(m, "LinkRegressors",
      "Derivative of r by inertial parameters of the robot's links, one part of a recording after the other.")
      .def(
          "__init__",
          [](LinkRegressors* r, const Tree& tree, const ObserverSettings& settings, const std::vector<int>& links,
             const std::vector<int>& parameters) { new (r) LinkRegressors(tree, settings, links, parameters); },
          nb::arg("tree"), nb::arg("settings"), nb::arg("links"), nb::arg("parameters"))
      .def(
          "rows",
          [](LinkRegressors& r, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q,
             const Array<double, 2>& dq, const Array<std::int64_t, 1>& samples) {
            const RecordingView part = view(t_ns, q, dq, q);
            std::vector<double> out;
            {
              nb::gil_scoped_release released;
              out = r.rows(part, span_of(samples));
            }
            return to_numpy(std::move(out), {samples.shape(0), q.shape(1), r.columns()});
          },
          nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"), nb::arg("samples"),
          "Rows at these samples of the next part: (samples, joints, links x parameters).");
  m.def(
      "presliding_states",
      [](const Array<double, 2>& q, const std::vector<double>& widths) {
        const std::size_t n = q.shape(1);
        Presliding bank(static_cast<int>(n), widths);
        std::vector<double> out(q.shape(0) * n * widths.size());
        const std::size_t columns = n * widths.size();
        {
          nb::gil_scoped_release released;
          for (std::size_t k = 0; k < q.shape(0); ++k) {
            bank.step({q.data() + k * n, n});
            bank.write({out.data() + k * columns, columns});
          }
        }
        return to_numpy(std::move(out), {q.shape(0), n, widths.size()});
      },
      nb::arg("q"), nb::arg("widths"),
      "Stop operators on finite positions (samples, joints), widths in rising order: states from -1 to 1, (samples, "
      "joints, widths).");
  m.def(
      "impossible_samples",
      [](const ObserverSettings& settings, const std::vector<double>& torque_nm, const std::vector<double>& speed_rad_s,
         const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
         const Array<double, 2>& tau) {
        const RecordingView recording = view(t_ns, q, dq, tau);
        std::vector<ImpossibleSample> found;
        {
          nb::gil_scoped_release released;
          // Saturated drives and frozen encoders are possible.
          const std::vector<double> any(q.shape(1), std::numeric_limits<double>::infinity());
          const std::vector<double> least(q.shape(1), std::numeric_limits<double>::min());
          found = impossible_samples(settings, {any, least, torque_nm, speed_rad_s}, recording);
        }
        std::vector<std::int64_t> samples;
        std::vector<std::uint32_t> causes;
        std::vector<std::int8_t> joints;
        for (const ImpossibleSample& one : found) {
          samples.push_back(one.sample);
          causes.push_back(one.found.cause);
          joints.push_back(static_cast<std::int8_t>(one.found.joint));
        }
        ArrayDict out;
        out["sample"] = to_numpy(std::move(samples), {found.size()});
        out["cause"] = to_numpy(std::move(causes), {found.size()});
        out["joint"] = to_numpy(std::move(joints), {found.size()});
        return out;
      },
      nb::arg("settings"), nb::arg("possible_torque_nm"), nb::arg("possible_speed_rad_s"), nb::arg("t_ns"), nb::arg(
           "q"),
      nb::arg("dq"), nb::arg("tau"),
      "Samples that are faults with these ranges: sample, cause (a bit) and the first joint concerned.");
  m.def(
      "mean_steps",
      [](std::int64_t sample_period_ns, int network_stride, const Array<std::int64_t, 1>& t_ns) {
        return to_numpy(mean_steps(sample_period_ns, network_stride, span_of(t_ns)), {t_ns.shape(0)});
      },
      nb::arg("sample_period_ns"), nb::arg("network_stride"), nb::arg("t_ns"),
      "Exponential mean of the step over a second at each sample, in sample periods, (samples,); the monitor compares it "
      "with 1.");
  m.attr("RATE_TOLERANCE_RANGE") =
      nb::make_tuple(SignalRanges::kLeastRateTolerance, SignalRanges::kMostRateTolerance);
  m.def(
      "feature_rows",
      [](const Observation& observation, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q,
         const Array<double, 2>& dq, const Array<double, 2>& tau, const Array<float, 1>& factors) {
        const RecordingView recording = view(t_ns, q, dq, tau);
        if (observation.row.size() != t_ns.shape(0)) throw Error("the observation is of another recording");
        return to_numpy(feature_rows(recording, observation, span_of(factors)),
                        {static_cast<std::size_t>(observation.row_count), factors.shape(0)});
      },
      nb::arg("observation"), nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"), nb::arg("tau"), nb::arg("factors"),
      "Inputs of the network, one row per network period, each times its factor: (rows, features).");
}

void bind_lstm(nb::module_& m) {
  nb::class_<LstmShape>(m, "LstmShape",
      "Sizes of the network; parameters are W_x, W_h, b, W_head, b_head, with gates in the order i, f, g, o.")
      .def(
          "__init__",
          [](LstmShape* s, int inputs, int hidden, int outputs) {
            LstmShape shape{inputs, hidden, outputs};
            shape.validate();
            new (s) LstmShape(shape);
          },
          nb::arg("inputs"), nb::arg("hidden"), nb::arg("outputs"))
      .def_ro("inputs", &LstmShape::inputs)
      .def_ro("hidden", &LstmShape::hidden)
      .def_ro("outputs", &LstmShape::outputs)
      .def_prop_ro("parameter_count", &LstmShape::parameter_count);
  m.def(
      "lstm_forward",
      [](const LstmShape& shape, const Array<float, 1>& parameters, const Array<float, 2>& rows, int stride, int length,
         const std::vector<std::pair<int, int>>& inputs, const Array<std::int64_t, 1>& ends, int threads) {
        const PythonWindows windows(rows, stride, length, inputs);
        std::vector<float> out(ends.shape(0) * shape.outputs);
        {
          nb::gil_scoped_release released;
          lstm_forward(shape, span_of(parameters), windows.rows, span_of(ends), out, threads);
        }
        return to_numpy(std::move(out), {ends.shape(0), static_cast<std::size_t>(shape.outputs)});
      },
      nb::arg("shape"), nb::arg("parameters"), nb::arg("rows"), nb::arg("stride"), nb::arg("length"), nb::arg("inputs"),
      nb::arg("ends"), nb::arg("threads"), "Output of the windows that end at `ends`: (ends, outputs), scaled units.");
  m.def(
      "lstm_gradient",
      [](const LstmShape& shape, const Array<float, 1>& parameters, const Array<float, 2>& rows, int stride, int length,
         const std::vector<std::pair<int, int>>& inputs, const Array<std::int64_t, 1>& ends,
         const Array<float, 2>& target_rows, int targets, int threads) {
        const PythonWindows windows(rows, stride, length, inputs);
        if (target_rows.shape(1) != static_cast<std::size_t>(shape.outputs))
          throw Error("target_rows must have the shape (rows, " + std::to_string(shape.outputs) + ")");
        std::vector<float> gradient(shape.parameter_count());
        double loss;
        {
          nb::gil_scoped_release released;
          loss = learn::lstm_gradient(shape, span_of(parameters), windows.rows, span_of(ends),
                                      {target_rows.data(), target_rows.size()}, targets, gradient, threads);
        }
        return std::pair(loss, to_numpy(std::move(gradient), {shape.parameter_count()}));
      },
      nb::arg("shape"), nb::arg("parameters"), nb::arg("rows"), nb::arg("stride"), nb::arg("length"), nb::arg("inputs"),
      nb::arg("ends"), nb::arg("target_rows"), nb::arg("targets"), nb::arg("threads"),
      "Mean squared error over the last `targets` steps of each sequence, and its gradient.");
  m.def(
      "lstm_activations",
      [](const Array<float, 1>& x) {
        const std::size_t N = x.shape(0);
        std::vector<float> sigmoid(N), tangent(N);
        lstm_activations(span_of(x), sigmoid, tangent);
        return std::pair(to_numpy(std::move(sigmoid), {N}), to_numpy(std::move(tangent), {N}));
      },
      nb::arg("x"), "sigmoid(x) and tanh(x) as the network computes them.");
  m.def("simd_in_use", &simd_in_use,
        "Instruction set of the network's kernels: the widest of this machine, or that of the environment variable "
        "TAUEXT_SIMD. Raises CoreError if this machine lacks it.");
}

void bind_bundle(nb::module_& m) {
  nb::enum_<TorqueUnit>(m, "TorqueUnit", "Unit of tau.")
      .value("newton_metre", TorqueUnit::newton_metre)
      .value("ampere", TorqueUnit::ampere)
      .value("recorded", TorqueUnit::recorded);
  nb::class_<TorqueUnits>(m, "TorqueUnits", "Units of the input tau and of the estimates; see bundle.hpp.")
      .def(
          "__init__",
          [](TorqueUnits* u, TorqueUnit given, int relative_to, std::vector<std::uint8_t> unknown) {
            new (u) TorqueUnits{given, relative_to, std::move(unknown)};
          },
          nb::arg("given") = TorqueUnit::newton_metre, nb::arg("relative_to") = -1,
          nb::arg("unknown") = std::vector<std::uint8_t>())
      .def_ro("given", &TorqueUnits::given)
      .def_ro("relative_to", &TorqueUnits::relative_to)
      .def_ro("unknown", &TorqueUnits::unknown);
  nb::class_<DriftSettings>(m, "DriftSettings",
      "Settings of the tracker of slow changes; see settings.hpp. time_constant_s = 0: no tracker.")
      .def(nb::init<>())
      .def_rw("time_constant_s", &DriftSettings::time_constant_s)
      .def_rw("size_nm", &DriftSettings::size_nm)
      .def_rw("rate_share_per_s", &DriftSettings::rate_share_per_s)
      .def_rw("freeze_share", &DriftSettings::freeze_share)
      .def_rw("freeze_s", &DriftSettings::freeze_s)
      .def_rw("freeze_floor_nm", &DriftSettings::freeze_floor_nm)
      .def_rw("friction_share", &DriftSettings::friction_share);
  nb::enum_<MotionFeature>(m, "MotionFeature", "Features of the motion with which errors grow; see settings.hpp.")
      .value("constant", MotionFeature::constant)
      .value("speed", MotionFeature::speed)
      .value("acceleration", MotionFeature::acceleration)
      .value("jerk", MotionFeature::jerk)
      .value("standstill", MotionFeature::standstill)
      .value("arm_speed", MotionFeature::arm_speed)
      .value("arm_acceleration", MotionFeature::arm_acceleration)
      .value("arm_jerk", MotionFeature::arm_jerk);
  nb::class_<ErrorScaleSettings>(m, "ErrorScaleSettings",
      "How limits and standard error grow with the motion; no features: constant limits.")
      .def(nb::init<>())
      .def_rw("features", &ErrorScaleSettings::features)
      .def_rw("limit_weights", &ErrorScaleSettings::limit_weights)
      .def_rw("largest", &ErrorScaleSettings::largest)
      .def_rw("sigma_weights", &ErrorScaleSettings::sigma_weights)
      .def_rw("sigma_near_weights", &ErrorScaleSettings::sigma_near_weights)
      .def_rw("largest_sigma", &ErrorScaleSettings::largest_sigma)
      .def_prop_ro("on", &ErrorScaleSettings::on, "Whether there is a standard error.")
      .def_prop_ro("follows", &ErrorScaleSettings::follows, "Whether limits and standard error follow the motion.");
  nb::class_<Load>(m, "Load", "A rigid body in the axes of the load frame; mass 0: no load.")
      .def(
          "__init__",
          [](Load* load, double mass, const std::array<double, 3>& com, const std::array<double, 6>& inertia,
             double error_share) { new (load) Load{mass, com, inertia, error_share}; },
          nb::arg("mass") = 0.0, nb::arg("com") = std::array<double, 3>{}, nb::arg("inertia") = std::array<double, 6>{},
          nb::arg("error_share") = Load::kUsualError,
          "Mass [kg], centre of mass [m], inertia about it xx, yy, zz, xy, xz, yz [kg m^2], relative error of its\n"
          "torques (0 to 1).")
      .def_ro("mass", &Load::mass, "Mass, [kg].")
      .def_ro("com", &Load::com, "Centre of mass, [m].")
      .def_ro("inertia", &Load::inertia, "Inertia about the centre of mass, xx, yy, zz, xy, xz, yz, [kg m^2].")
      .def_ro("error_share", &Load::error_share, "Relative error of its torques: limits rise by this share of them.")
      .def("__eq__", [](const Load& a, const Load& b) { return a == b; }, nb::is_operator(),
           nb::sig("def __eq__(self, other: object, /) -> bool"));
  nb::class_<LoadSettings>(m, "LoadSettings", "Where a load is fixed, and which loads are accepted; see load.hpp.")
      .def(nb::init<>())
      .def_rw("frame", &LoadSettings::frame, "Name of the load frame.")
      .def_rw("link", &LoadSettings::link, "Index of the link that the frame is fixed to; -1: none.")
      .def_rw("rotation", &LoadSettings::rotation, "Rotation link from load frame, row-major.")
      .def_rw("translation", &LoadSettings::translation, "Origin of the frame in the link's frame, [m].")
      .def_rw("largest_mass_kg", &LoadSettings::largest_mass_kg, "Largest accepted mass, [kg].")
      .def_rw("largest_reach_m", &LoadSettings::largest_reach_m,
           "Largest accepted distance of the centre of mass from the frame's origin, [m].")
      .def_rw("refused", &LoadSettings::refused, "Reason for which no load can be set; empty: loads are accepted.")
      .def_prop_ro("settable", &LoadSettings::settable, "Whether a load can be set at all.")
      .def("why_not", [](const LoadSettings& s, const Load& load) { return s.words(s.fault(load), load); },
           nb::arg("load"), "Reason for which this load is refused; empty: accepted.")
      .def("merged", [](const LoadSettings& s, const Load& load, const Link& link) { return s.merged(load, link); },
           nb::arg("load"), nb::arg("link"), "The link and the load as one body.");
  nb::class_<Bundle> bundle(m, "Bundle", "A bundle: all settings and weights of the chain, in one file.");
  bundle.def(nb::init<>())
      .def_rw("name", &Bundle::name, "Name of the bundle; its file may have another name.")
      .def_rw("provenance", &Bundle::provenance,
              "JSON text: command, versions, settings, recordings and results of the training. The core does not read it.")
      .def_rw("gravity", &Bundle::gravity, "Acceleration of free fall in the base frame, [m/s^2].")
      .def_rw("observer", &Bundle::observer,
              "Gain K0 [1/s], torque timing, sample period [ns], rate of the network; torque constants.")
      .def_rw("window_steps", &Bundle::window_steps, "Network steps in a window.")
      .def_rw("shape", &Bundle::shape, "Inputs, hidden units and outputs of the network; hidden = 0: no network.")
      .def_prop_ro("joints", &Bundle::joints, "Number of joints.")
      .def_prop_ro(
          "monitored",
          [](const Bundle& b) {
            std::vector<bool> all;
            for (int j = 0; j < b.joints(); ++j) all.push_back(b.limits.monitors(j));
            return all;
          },
          "Whether each joint can raise an alarm; one that never moved in training has infinite limits and cannot.")
      .def_prop_ro("has_network", &Bundle::has_network, "Whether there is a network; False: observer and prior only.")
      .def_rw("units", &Bundle::units,
              "Units of the input tau and of the estimates; torque_units and estimate_units are their names.")
      .def_rw("load_settings", &Bundle::load, "Load frame, and bounds on loads.")
      .def_rw("wrench_settings", &Bundle::wrench, "Error model of forces and moments at frames.")
      .def_rw("capsules", &Bundle::capsules, "Shapes of the links, from the robot file; empty: none.")
      .def_rw("servo", &Bundle::servo, "Computation of dq and tau from servo signals, before the chain; may be off.")
      .def_prop_ro(
          "in_newtons",
          [](const Bundle& b) {
            std::vector<bool> out;
            for (int j = 0; j < b.joints(); ++j) out.push_back(b.in_newtons(j));
            return out;
          },
          "Per joint: whether its estimates are in N m, N or W. Only these joints are used for loads and forces.")
      .def("too_few_in_newtons", &Bundle::too_few_in_newtons, nb::arg("why"),
           "Empty if enough joints are in N m; else a sentence that ends with `why`.")
      .def_prop_ro("most_units_per_nm", &Bundle::most_units_per_nm,
                   "Per joint: bound on the change of its estimate, in its own unit, per N m of a load; 0 for joints in N m.")
      .def("assume_load", &Bundle::assume_load, "Sets the default load settings; see bundle.hpp.")
      .def_prop_ro("torque_units", [](const Bundle& b) { return units(b, &Bundle::torque_unit); },
                   "Unit of the input tau, per joint.")
      .def_prop_ro("estimate_units", [](const Bundle& b) { return units(b, &Bundle::estimate_unit); },
                   "Unit of the estimated torques, per joint.")
      .def_prop_rw(
          "inputs", [](const Bundle& b) { return input_pairs(b.inputs); },
          [](Bundle& b, const std::vector<std::pair<int, int>>& pairs) {
            b.inputs.clear();
            for (const auto& [column, lag] : pairs) b.inputs.push_back({column, lag});
          },
          "Inputs of a network step: pairs of a column (q, dq, then presliding states of every joint) and a lag in steps.")
      .def_prop_rw(
          "contact_release_s", [](const Bundle& b) { return b.limits.contact_release_s; },
          [](Bundle& b, double v) { b.limits.contact_release_s = v; },
          "A contact ends when every joint has been below its contact limit for this time, [s].")
      .def_prop_rw(
          "near_memory_s", [](const Bundle& b) { return b.limits.near_memory_s; },
          [](Bundle& b, double v) { b.limits.near_memory_s = v; },
          "Time after the start of sliding for which a joint counts as near stiction, [s].")
      .def_prop_rw(
          "after_contact_factor", [](const Bundle& b) { return b.limits.after_contact_factor; },
          [](Bundle& b, double v) { b.limits.after_contact_factor = v; },
          "Factor on the limits of a joint that was pushed while stuck, until it has slid; 1: none.")
      .def_prop_rw(
          "declared_spread", [](const Bundle& b) { return b.limits.declared_spread; },
          [](Bundle& b, double v) { b.limits.declared_spread = v; },
          "Standard errors by which what a declared contact explains may be wrong.")
      .def_prop_rw(
          "torque_limit_nm", [](const Bundle& b) { return b.signals.torque_limit_nm; },
          [](Bundle& b, std::vector<double> v) { b.signals.torque_limit_nm = std::move(v); },
          "Torque at which each drive saturates, [N m]; infinite: unknown.")
      .def_prop_rw(
          "largest_torque_nm", [](const Bundle& b) { return b.signals.largest_torque_nm; },
          [](Bundle& b, std::vector<double> v) { b.signals.largest_torque_nm = std::move(v); },
          "Largest |tau| of each joint in training, [N m].")
      .def_prop_rw(
          "possible_torque_nm", [](const Bundle& b) { return b.signals.possible_torque_nm; },
          [](Bundle& b, std::vector<double> v) { b.signals.possible_torque_nm = std::move(v); },
          "Per joint: a larger |tau| is a fault, [N m]; infinite: unknown.")
      .def_prop_rw(
          "possible_speed_rad_s", [](const Bundle& b) { return b.signals.possible_speed_rad_s; },
          [](Bundle& b, std::vector<double> v) { b.signals.possible_speed_rad_s = std::move(v); },
          "Per joint: a larger |dq|, or a step of q that needs one, is a fault, [rad/s]; infinite: unknown.")
      .def_prop_rw(
          "rate_tolerance", [](const Bundle& b) { return b.signals.rate_tolerance; },
          [](Bundle& b, double v) { b.signals.rate_tolerance = v; },
          "Largest relative difference between mean step and sample period, 0.05 to 0.15.")
      .def_prop_rw(
          "region_width", [](const Bundle& b) { return b.limits.region_width; },
          [](Bundle& b, int v) { b.limits.region_width = v; },
          "Index of the presliding width that, beside the speed, defines near stiction; -1: speed only.")
      .def_prop_rw(
          "near_stiction_rad_s", [](const Bundle& b) { return b.limits.near_stiction_rad_s; },
          [](Bundle& b, double v) { b.limits.near_stiction_rad_s = v; },
          "A joint slower than this is near stiction, [rad/s].")
      .def(
          "drop_network",
          [](Bundle& b) {
            b.shape = {};
            b.inputs.clear();
            b.input_factors.clear();
            b.parameters.clear();
            b.output_scale_nm.clear();
            answer_reference(b);
          },
          "Removes the network; observer and prior remain. Raises CoreError without a reference.")
      .def("answer_reference", [](Bundle& b) { answer_reference(b); }, "Recomputes the reference after a change.")
      .def_prop_ro(
          "reference_q",
          [](const Bundle& b) {
            const std::size_t n = std::min(b.links.size(), b.reference.q.size());
            return std::vector<double>(b.reference.q.begin(), b.reference.q.begin() + static_cast<std::ptrdiff_t>(n));
          },
          "Position of each joint at the reference's first sample, [rad] or [m]; empty: no reference.")
      .def(
          "set_reference",
          [](Bundle& b, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
             const Array<double, 2>& tau) {
            const RecordingView v = view(t_ns, q, dq, tau);
            const auto cells = static_cast<std::size_t>(v.samples) * v.joints;
            b.reference = {{v.t_ns, v.t_ns + v.samples}, {v.q, v.q + cells}, {v.dq, v.dq + cells},
                           {v.tau, v.tau + cells}, {}, {}, {}};
            answer_reference(b);
          },
          nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"), nb::arg("tau"),
          "Stores this section of free motion with the chain's estimate at its last sample; loading a bundle replays it.")
      .def_prop_ro("model_digest", &model_digest,
                   "Checksum of all that tau_ext is made of, drift excluded; bundles that differ in limits alone have the same.")
      .def("save", [](const Bundle& b, const std::string& path) { save_bundle(b, path); }, nb::arg("path"),
           "Writes the file to a temporary name and renames it. Raises CoreError with the invalid field or the write error.")
      .def_static("load", [](const std::string& path) {
                    const nb::gil_scoped_release released;
                    return load_bundle(path);
                  },
                  nb::arg("path"),
                  "Reads and checks the file and replays its reference. Raises CoreError with the reason of a refusal.")
      .def(
          "to_bytes",
          [](const Bundle& b) {
            const std::vector<char> bytes = to_bytes(b);
            return nb::bytes(bytes.data(), bytes.size());
          },
          "The content of the bundle's file.")
      .def(
          "scale_reference",
          [](Bundle& b, const std::vector<double>& by) {
            if (by.size() != b.links.size()) throw Error("scale_reference takes one factor a joint");
            for (std::size_t k = 0; k < b.reference.tau.size(); ++k) b.reference.tau[k] *= by[k % by.size()];
            answer_reference(b);
          },
          nb::arg("by"), "Multiplies the reference's tau by one factor per joint and recomputes it.")
      .def_static(
          "from_bytes", [](nb::bytes bytes) { return from_bytes({bytes.c_str(), bytes.size()}); }, nb::arg("bytes"),
          "Reads the bytes of to_bytes(), with the checks of load().");
  bind_level(bundle, "", &Limits::collision);
  bind_level(bundle, "contact_", &Limits::contact);
  bind_list(bundle, "links", &Bundle::links,
            "Moving links of the estimated model with their joints. A copy: change it and assign it.");
  bind_list(bundle, "input_factors", &Bundle::input_factors,
            "Factor on each input column: 1 / its largest absolute value in training.");
  bind_list(bundle, "parameters", &Bundle::parameters, "Weights of the network, in the order of LstmShape.");
  bundle.def_rw("prior", &Bundle::prior,
                "Prior of r: terms and their weights; no terms: no prior.");
  bundle.def_rw("drift", &Bundle::drift, "Settings of the tracker of slow changes; time_constant_s = 0: no tracker.");
  bundle.def_rw("error_scale", &Bundle::error_scale,
                "How limits and standard error follow the motion; no features: constant limits.");
  bundle.def_rw("coverage", &Bundle::coverage,
       "Motion of the training recordings; empty: unknown, and all motion is familiar.");
  bind_list(bundle, "output_scale_nm", &Bundle::output_scale_nm,
            "Per joint: torque of a network output of 1, [N m]; 0: the network is switched off.");
  m.def(
      "estimate",
      [](const Bundle& b, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
         const Array<double, 2>& tau, int threads, const Temperatures& temperature,
         const std::optional<Array<float, 2>>& outputs, const std::vector<std::string>& torques,
         const std::vector<std::tuple<NamedContact, std::int64_t, double>>& contacts) {
        const RecordingView recording = view(t_ns, q, dq, tau, temperature);
        std::vector<TimedContact> timed;
        for (const auto& [named, from_ns, seconds] : contacts)
          timed.push_back({contact_of(WrenchModel(b), named), from_ns, seconds});
        const auto known = outputs ? std::span<const float>(outputs->data(), outputs->size()) : std::span<const float>();
        Estimates e;
        {
          nb::gil_scoped_release released;
          e = estimate(b, recording, threads, known, torques, timed);
        }
        const std::size_t N = t_ns.shape(0), n = q.shape(1);
        ArrayDict out;
        for (const TorqueColumn& one : kTorqueColumns)
          if (torques.empty() || std::ranges::find(torques, one.name) != torques.end())
            out[one.name] = to_numpy(std::move(e.*one.column), {N, n});
        out["unfamiliar"] = to_numpy(std::move(e.unfamiliar), {N});
        out["unseen"] = to_numpy(std::move(e.unseen), {N});
        out["unseen_joint"] = to_numpy(std::move(e.unseen_joint), {N});
        out["unseen_other"] = to_numpy(std::move(e.unseen_other), {N});
        out["near_stiction"] = to_numpy(std::move(e.near_stiction), {N, n});
        out["health"] = to_numpy(std::move(e.health), {N});
        out["causes"] = to_numpy(std::move(e.causes), {N});
        out["cause_joint"] = to_numpy(std::move(e.cause_joint), {N});
        out["detection"] = to_numpy(std::move(e.detection), {N});
        out["alarm"] = to_numpy(std::move(e.alarm), {N});
        out["alarm_joint"] = to_numpy(std::move(e.alarm_joint), {N});
        out["held_alarm"] = to_numpy(std::move(e.held_alarm), {N});
        out["touch"] = to_numpy(std::move(e.touch), {N});
        out["declared"] = to_numpy(std::move(e.declared), {N});
        out["declared_contact"] = to_numpy(std::move(e.declared_contact), {N});
        out["declared_size"] = to_numpy(std::move(e.declared_size), {N});
        out["declared_sigma"] = to_numpy(std::move(e.declared_sigma), {N});
        out["entered"] = to_numpy(std::move(e.entered), {N});
        out["restarted"] = to_numpy(std::move(e.restarted), {N});
        return out;
      },
      nb::arg("bundle"), nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"), nb::arg("tau"), nb::arg("threads"),
      nb::arg("temperature") = nb::none(), nb::arg("outputs") = nb::none(),
      nb::arg("torques") = std::vector<std::string>(),
      nb::arg("contacts") = std::vector<std::tuple<NamedContact, std::int64_t, double>>(),
      "Runs the whole chain on a recording; the results equal those of run() of a new Monitor. outputs: those of "
      "network_outputs(), so that the network is not run again. torques: names of the torque columns that are returned; "
      "empty: all. contacts: declared contacts, from a time [ns] on, for seconds. See estimates.hpp.");
  m.def(
      "network_outputs",
      [](const Bundle& b, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& q, const Array<double, 2>& dq,
         const Array<double, 2>& tau, int threads, const Temperatures& temperature) {
        const RecordingView recording = view(t_ns, q, dq, tau, temperature);
        std::vector<float> outputs;
        {
          nb::gil_scoped_release released;
          outputs = network_outputs(b, recording, threads);
        }
        const std::size_t n = q.shape(1), judged = outputs.size() / n;
        return to_numpy(std::move(outputs), {judged, n});
      },
      nb::arg("bundle"), nb::arg("t_ns"), nb::arg("q"), nb::arg("dq"), nb::arg("tau"), nb::arg("threads"),
      nb::arg("temperature") = nb::none(),
      "The network's outputs for each judged sample of a recording, (judged, joints); none without a network.");
  m.def(
      "motion_errors",
      [](const Bundle& b, const Array<std::int64_t, 1>& t_ns, const Array<double, 2>& dq,
         const Array<std::uint8_t, 2>& near_stiction, const Array<std::uint8_t, 1>& entered,
         const Array<std::uint8_t, 1>& restarted, const Array<std::int64_t, 1>& rows) {
        const std::size_t samples = dq.shape(0) * dq.shape(1), near = near_stiction.shape(0) * near_stiction.shape(1);
        MotionErrors e;
        {
          nb::gil_scoped_release released;
          e = motion_errors(b,
                            {span_of(t_ns), {dq.data(), samples}, {near_stiction.data(), near}, span_of(entered),
                             span_of(restarted)},
                            span_of(rows));
        }
        const std::size_t N = rows.shape(0), n = dq.shape(1);
        ArrayDict out;
        out["features"] = to_numpy(std::move(e.features), {N, n, b.error_scale.features.size()});
        out["scale"] = to_numpy(std::move(e.scale), {N, n});
        out["sigma_nm"] = to_numpy(std::move(e.sigma_nm), {N, n});
        return out;
      },
      nb::arg("bundle"), nb::arg("t_ns"), nb::arg("dq"), nb::arg("near_stiction"), nb::arg("entered"),
      nb::arg("restarted"), nb::arg("rows"),
      "Features, scale and standard error of the bundle's error scale at these rows of a motion; see estimates.hpp.");
  m.def(
      "errors_after",
      [](const Bundle& b, const std::vector<double>& speeds_rad_s, bool near_stiction) {
        const auto n = static_cast<std::size_t>(b.joints()), samples = speeds_rad_s.size();
        std::vector<std::int64_t> t_ns(samples);
        std::vector<double> dq;
        for (std::size_t k = 0; k < samples; ++k) {
          t_ns[k] = static_cast<std::int64_t>(k) * b.observer.sample_period_ns;
          dq.insert(dq.end(), n, speeds_rad_s[k]);
        }
        const std::vector<std::uint8_t> near(samples * n, near_stiction), entered(samples, 1), restarted(samples, 0);
        const std::int64_t last = static_cast<std::int64_t>(samples) - 1;
        const MotionErrors e = motion_errors(b, {t_ns, dq, near, entered, restarted}, {&last, 1});
        return std::pair(e.scale, e.sigma_nm);
      },
      nb::arg("bundle"), nb::arg("speeds_rad_s"), nb::arg("near_stiction"),
      "Scale and standard error of each joint at the end of a motion in which every joint has these speeds, one sample "
      "period apart. near_stiction: state at the end. Returns lists, so that NumPy is not loaded.");
}

// Results are equal to the last bit only within the build of one compiler.
#ifdef __clang__
constexpr const char* kCompiler = __VERSION__;  // begins with its name
#else
constexpr const char* kCompiler = "gcc " __VERSION__;
#endif

}  // namespace

NB_MODULE(_core, m) {
  m.attr("__version__") = TAUEXT_VERSION;
  m.attr("COMPILER") = kCompiler;
  m.attr("BUNDLE_FORMAT") = kBundleMajor;
  m.attr("MAX_JOINTS") = kMaxJoints;
  nb::exception<Error>(m, "CoreError", nb::module_::import_("tauext.errors").attr("TauextError"));
  bind_wrench(m);
  bind_places(m);
  bind_servo(m);
  bind_tree(m);
  bind_observer(m);
  bind_lstm(m);
  bind_bundle(m);
  bind_coverage(m);
  bind_load(m);
  bind_load_found(m);
  bind_contact(m);
  bind_monitor(m);
  bind_refit(m);
  // The stub is read off a module without a package; its signatures are those of the calls that succeed.
  if (nb::cast<std::string>(m.attr("__name__")) != "_core") refuse_wrong_arguments(m);
}
