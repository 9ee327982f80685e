// Plays the controller manager for the plug-in of a library:
//
//   controller_manager LIBRARY RATE_HZ [PARAMETER=VALUE...]
//
// Lines of stdin are cycles: t_ns, then position, velocity and effort of each joint. An h in place of a number: another
// thread holds this interface. A line `off` deactivates and activates the controller. Each line is answered by the
// values of the exported interfaces on stdout, before them the names: required, then exported interfaces. The last line
// is the number of allocations in update() and, as a positive control, in configuring.
#include <dlfcn.h>

#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <sstream>

#include "controller_interface/chainable_controller_interface.hpp"

static long allocations = 0;
extern "C" {
void* __libc_malloc(std::size_t);
void* malloc(std::size_t size) { return ++allocations, __libc_malloc(size); }
}

namespace ci = controller_interface;

namespace {

// The values of `point` and `at_most_...` are numbers; others are names, with commas a list of them.
rclcpp_lifecycle::LifecycleNode::Parameters parameters(int count, char** words) {
  rclcpp_lifecycle::LifecycleNode::Parameters found;
  for (int k = 0; k < count; ++k) {
    const std::string word = words[k], name = word.substr(0, word.find('=')), text = word.substr(name.size() + 1);
    std::istringstream parts(text);
    std::vector<std::string> list;
    for (std::string part; std::getline(parts, part, ',');) list.push_back(part);
    if (name == "point") {
      std::vector<double> numbers;
      for (const std::string& part : list) numbers.push_back(std::strtod(part.c_str(), nullptr));
      found[name] = numbers;
    } else if (name.starts_with("at_most")) {
      found[name] = std::strtod(text.c_str(), nullptr);
    } else if (text.find(',') != std::string::npos) {
      found[name] = list;
    } else {
      found[name] = text;
    }
  }
  return found;
}

int fail(const char* what) { return std::fprintf(stderr, "%s\n", what), 1; }

}  // namespace

int main(int argc, char** argv) {
  void* library = argc < 3 ? nullptr : dlopen(argv[1], RTLD_NOW);
  if (!library) return fail(argc < 3 ? "usage: controller_manager LIBRARY RATE_HZ [PARAMETER=VALUE...]" : dlerror());
  const auto create = reinterpret_cast<ci::ChainableControllerInterface* (*)()>(dlsym(library, "mock_create"));
  const std::unique_ptr<ci::ChainableControllerInterface> controller(create());
  const auto rate_hz = static_cast<unsigned int>(std::atoi(argv[2]));
  if (controller->mock_init("tool_force", parameters(argc - 3, argv + 3), rate_hz) != ci::CallbackReturn::SUCCESS)
    return 2;
  const long before = allocations;
  if (controller->on_configure({}) != ci::CallbackReturn::SUCCESS) return 3;
  const long configuring = allocations - before;
  const auto exported = controller->export_state_interfaces();
  const auto wanted = controller->state_interface_configuration().names;
  for (const std::string& name : wanted) std::cout << name << (name == wanted.back() ? "\n" : " ");
  for (const auto& one : exported) std::cout << one->get_name() << (one == exported.back() ? "\n" : " ");
  if (controller->command_interface_configuration().type != ci::interface_configuration_type::NONE) return fail("commands");

  std::vector<hardware_interface::StateInterface::SharedPtr> hardware;
  const auto activate = [&] {
    std::vector<hardware_interface::LoanedStateInterface> loaned;
    for (const auto& one : hardware) loaned.emplace_back(one);
    controller->assign_interfaces(std::move(loaned));
    return controller->set_chained_mode(true) && controller->on_activate({}) == ci::CallbackReturn::SUCCESS;
  };
  if (activate()) return fail("activated without interfaces");
  for (const std::string& name : wanted) {
    const auto slash = name.rfind('/');
    hardware.push_back(std::make_shared<hardware_interface::StateInterface>(name.substr(0, slash), name.substr(slash + 1)));
  }
  if (!activate()) return fail("not activated");

  long updating = 0;
  std::cout.precision(17);
  for (std::string line; std::getline(std::cin, line);) {
    if (line == "off") {
      controller->on_deactivate({});
      for (const auto& one : exported) std::cout << one->get_optional().value() << (one == exported.back() ? "\n" : " ");
      if (!activate()) return fail("not activated again");
      continue;
    }
    std::istringstream cells(line);
    std::int64_t t_ns = 0;
    cells >> t_ns;
    for (const auto& one : hardware) {
      std::string cell;
      cells >> cell;
      one->held = cell == "h";
      if (!one->held && !one->set_value(std::strtod(cell.c_str(), nullptr))) return fail("not set");
    }
    const long so_far = allocations;
    if (controller->update(rclcpp::Time(t_ns), rclcpp::Duration(0, 0)) != ci::return_type::OK) return fail("update");
    updating += allocations - so_far;
    for (const auto& one : exported) std::cout << one->get_optional().value() << (one == exported.back() ? "\n" : " ");
  }
  std::cout << updating << " " << configuring << "\n";
}
