// A force-torque sensor for ros2_control that is computed from the joints' positions, velocities and efforts.
#pragma once
#include <array>
#include <cstddef>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <controller_interface/chainable_controller_interface.hpp>
#include <hardware_interface/handle.hpp>
#include <rclcpp/duration.hpp>
#include <rclcpp/time.hpp>
#include <rclcpp_lifecycle/state.hpp>
#include <tauext/monitor.hpp>

namespace tauext_ros2_control {

// Runs a bundle on the joints' state interfaces and exports state interfaces NAME/force.x, force.y, force.z [N] and
// NAME/torque.x, torque.y, torque.z [N m], NAME being the controller's name. They are the force that the environment
// exerts on the arm and its moment about the frame's origin, along the frame's axes; all six are NaN while unknown.
// Besides: NAME/error, the standard error of the force [N], and NAME/health and NAME/alarm, the numbers of tauext::Health
// and of the tauext::Alarm that holds at this sample.
//
// It commands no joint. Between on_activate and on_deactivate nothing allocates, throws or logs.
class ToolForceSensor : public controller_interface::ChainableControllerInterface {
 public:
  controller_interface::CallbackReturn on_init() override;
  controller_interface::CallbackReturn on_configure(const rclcpp_lifecycle::State& previous) override;
  controller_interface::CallbackReturn on_activate(const rclcpp_lifecycle::State& previous) override;
  controller_interface::CallbackReturn on_deactivate(const rclcpp_lifecycle::State& previous) override;
  controller_interface::InterfaceConfiguration command_interface_configuration() const override;
  controller_interface::InterfaceConfiguration state_interface_configuration() const override;
  controller_interface::return_type update_and_write_commands(const rclcpp::Time& time,
                                                              const rclcpp::Duration& period) override;

 protected:
  std::vector<hardware_interface::StateInterface::SharedPtr> on_export_state_interfaces_list() override;
  std::vector<hardware_interface::CommandInterface::SharedPtr> on_export_reference_interfaces_list() override;
  controller_interface::return_type update_reference_from_subscribers(const rclcpp::Time& time,
                                                                      const rclcpp::Duration& period) override;
  bool on_set_chained_mode(bool chained) override;

 private:
  static constexpr std::size_t kExported = 9;

  // Makes the monitor and resolves the parameters. Throws tauext::Error with the reason.
  void load();
  // Fills q_, dq_ and tau_; false: another thread holds one of the interfaces, so that this cycle has no sample.
  bool read_joints();
  void write(const std::array<double, kExported>& values);

  std::optional<tauext::Monitor> monitor_;
  std::vector<std::string> joints_;            // names of the hardware's joints, in the bundle's order
  int frame_ = -1;                             // of the bundle's WrenchModel
  std::optional<std::array<double, 3>> point_; // a force without a moment acts here, [m] along the frame's axes
  std::optional<tauext::DeclaredContact> contact_;  // of the task, in effect while the controller is active
  std::vector<double> q_, dq_, tau_;
  std::vector<hardware_interface::StateInterface::SharedPtr> exported_;
};

}  // namespace tauext_ros2_control
