// Mock of controller_interface: virtual functions as in ros2_control 4.44 and later, and the part of the controller
// manager that calls them.
#pragma once
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "hardware_interface/handle.hpp"
#include "rclcpp/duration.hpp"
#include "rclcpp/time.hpp"
#include "rclcpp_lifecycle/lifecycle_node.hpp"

namespace controller_interface {

using CallbackReturn = rclcpp_lifecycle::node_interfaces::LifecycleNodeInterface::CallbackReturn;

enum class return_type : std::uint8_t { OK, ERROR };
enum class interface_configuration_type : std::uint8_t { ALL, INDIVIDUAL, NONE };
struct InterfaceConfiguration {
  interface_configuration_type type;
  std::vector<std::string> names = {};
};

class ChainableControllerInterface : public rclcpp_lifecycle::node_interfaces::LifecycleNodeInterface {
 public:
  virtual CallbackReturn on_init() = 0;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;

  // Stands in for init(), which takes these from a file of parameters.
  CallbackReturn mock_init(const std::string& name, const rclcpp_lifecycle::LifecycleNode::Parameters& parameters,
                           unsigned int rate_hz) {
    node_ = std::make_shared<rclcpp_lifecycle::LifecycleNode>(name, parameters);
    rate_hz_ = rate_hz;
    return on_init();
  }
  void assign_interfaces(std::vector<hardware_interface::LoanedStateInterface>&& states) {
    state_interfaces_ = std::move(states);
  }
  std::vector<hardware_interface::StateInterface::SharedPtr> export_state_interfaces() {
    auto exported = on_export_state_interfaces_list();
    for (const auto& one : exported)
      if (one->get_prefix_name() != node_->get_name()) throw std::runtime_error(one->get_name() + ": wrong prefix");
    if (exported.empty() && on_export_reference_interfaces_list().empty())
      throw std::runtime_error("a chainable controller must export an interface");
    return exported;
  }
  bool set_chained_mode(bool chained) { return on_set_chained_mode(chained) && (chained_ = chained, true); }
  return_type update(const rclcpp::Time& time, const rclcpp::Duration& period) {
    if (!chained_ && update_reference_from_subscribers(time, period) != return_type::OK) return return_type::ERROR;
    return update_and_write_commands(time, period);
  }
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> get_node() const { return node_; }
  unsigned int get_update_rate() const { return rate_hz_; }

 protected:
  template <typename T>
  void auto_declare(const std::string& name, const T& value) {
    node_->declare(name, value);
  }
  virtual std::vector<hardware_interface::StateInterface::SharedPtr> on_export_state_interfaces_list() { return {}; }
  virtual std::vector<hardware_interface::CommandInterface::SharedPtr> on_export_reference_interfaces_list() = 0;
  virtual bool on_set_chained_mode(bool) { return true; }
  virtual return_type update_reference_from_subscribers(const rclcpp::Time&, const rclcpp::Duration&) = 0;
  virtual return_type update_and_write_commands(const rclcpp::Time&, const rclcpp::Duration&) = 0;

  std::vector<hardware_interface::LoanedStateInterface> state_interfaces_;

 private:
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> node_;
  unsigned int rate_hz_ = 0;
  bool chained_ = false;
};

}  // namespace controller_interface
