// Python module tauext._core: checks shapes and forwards. The interpreter lock is released in every call over many samples.
#include "arrays.hpp"
#include "tauext/bundle.hpp"

namespace nb = nanobind;
using namespace tauext;
using namespace tauext::bindings;

namespace {

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
  bind_estimates(m);
  bind_coverage(m);
  bind_load(m);
  bind_load_found(m);
  bind_contact(m);
  bind_estimate(m);
  bind_flights(m);
  bind_monitor(m);
  bind_refit(m);
  // The stub is read off a module without a package; its signatures are those of the calls that succeed.
  if (nb::cast<std::string>(m.attr("__name__")) != "_core") refuse_wrong_arguments(m);
}
