// Observer and prior: their settings, and what they give for recordings.
#include <nanobind/stl/vector.h>

#include <limits>

#include "arrays.hpp"
#include "chain/motion.hpp"
#include "fit/regressors.hpp"
#include "prior/prior.hpp"
#include "stages/observation.hpp"
#include "stages/estimates.hpp"

namespace tauext::bindings {
namespace {

void bind_observer_settings(nb::module_& m) {
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
                               "of its filters [1/s], 0: none; torque constants, factors on tau, empty: none; per joint 1 where "
                               "the constant is unknown: tau and r in the input's unit, r without the model; empty: none is.")
      .def(
          "__init__",
          [](ObserverSettings* s, double gain_per_s, TorqueTiming timing, std::int64_t sample_period_ns,
             int network_stride, ResidualMethod method, double high_pass_per_s, double low_pass_per_s,
             std::vector<double> nm_per_unit, std::vector<std::uint8_t> unknown_constant) {
            new (s) ObserverSettings{gain_per_s,      timing,         sample_period_ns,       network_stride, method,
                                     high_pass_per_s, low_pass_per_s, std::move(nm_per_unit), std::move(unknown_constant)};
          },
          nb::kw_only(), nb::arg("gain_per_s"), nb::arg("timing"), nb::arg("sample_period_ns"),
          nb::arg("network_stride"), nb::arg("method") = ResidualMethod::momentum, nb::arg("high_pass_per_s") = 0.0,
          nb::arg("low_pass_per_s") = 0.0, nb::arg("nm_per_unit") = std::vector<double>(),
          nb::arg("unknown_constant") = std::vector<std::uint8_t>())
      .def_ro("gain_per_s", &ObserverSettings::gain_per_s)
      .def_ro("timing", &ObserverSettings::timing)
      .def_ro("sample_period_ns", &ObserverSettings::sample_period_ns)
      .def_ro("network_stride", &ObserverSettings::network_stride)
      .def_ro("method", &ObserverSettings::method)
      .def_ro("high_pass_per_s", &ObserverSettings::high_pass_per_s)
      .def_ro("low_pass_per_s", &ObserverSettings::low_pass_per_s)
      .def_ro("nm_per_unit", &ObserverSettings::nm_per_unit)
      .def_ro("unknown_constant", &ObserverSettings::unknown_constant);
}

void bind_prior_settings(nb::module_& m) {
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
      .def_rw("temperature", &PriorSettings::temperature)
      .def("friction_at_rest_nm", [](const PriorSettings& p, int joint) { return friction_line(p, static_cast<std::size_t>(joint)).at_rest_nm; },
           nb::arg("joint"), "Friction that a joint may hide at rest, [N m]: the friction line at speed 0.");
}

void bind_observation(nb::module_& m) {
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
}

void bind_regressors(nb::module_& m) {
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
}

void bind_signals(nb::module_& m) {
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

}  // namespace

void bind_observer(nb::module_& m) {
  bind_observer_settings(m);
  bind_prior_settings(m);
  bind_observation(m);
  bind_regressors(m);
  bind_signals(m);
}

}  // namespace tauext::bindings
