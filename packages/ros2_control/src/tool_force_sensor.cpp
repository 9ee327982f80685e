#include "tauext_ros2_control/tool_force_sensor.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <exception>
#include <limits>
#include <thread>

#include <hardware_interface/types/hardware_interface_type_values.hpp>
#include <pluginlib/class_list_macros.hpp>
#include <rclcpp/logging.hpp>

namespace tauext_ros2_control {

using controller_interface::CallbackReturn;
using controller_interface::interface_configuration_type;
using controller_interface::InterfaceConfiguration;
using controller_interface::return_type;

namespace {

// The standard names of a force-torque sensor, then those of this one.
constexpr std::array<const char*, 9> kNames = {"force.x",  "force.y",  "force.z", "torque.x", "torque.y",
                                               "torque.z", "error",    "health",  "alarm"};
constexpr double kUnknown = std::numeric_limits<double>::quiet_NaN();
constexpr std::array<const char*, 3> kRead = {hardware_interface::HW_IF_POSITION, hardware_interface::HW_IF_VELOCITY,
                                              hardware_interface::HW_IF_EFFORT};
// Tries to write an interface that another thread is reading; ros2_control tries as often where it reads one.
constexpr int kTries = 10;

std::string listed(const std::vector<std::string>& names) {
  std::string text;
  for (const std::string& name : names) text += (text.empty() ? "" : ", ") + name;
  return text;
}

template <std::size_t n>
std::array<double, n> unknown() {
  std::array<double, n> values;
  values.fill(kUnknown);
  return values;
}

}  // namespace

CallbackReturn ToolForceSensor::on_init() {
  try {
    auto_declare<std::string>("bundle", "");
    auto_declare<std::string>("frame", "");
    auto_declare<std::vector<double>>("point", {});
    auto_declare<double>("at_most_n", 0);
    auto_declare<double>("at_most_nm", 0);
    auto_declare<std::vector<std::string>>("joints", {});
  } catch (const std::exception& wrong) {  // a parameter of another type
    RCLCPP_ERROR(get_node()->get_logger(), "%s", wrong.what());
    return CallbackReturn::ERROR;
  }
  return CallbackReturn::SUCCESS;
}

CallbackReturn ToolForceSensor::on_configure(const rclcpp_lifecycle::State&) {
  try {
    load();
  } catch (const std::exception& refused) {
    monitor_.reset();
    RCLCPP_ERROR(get_node()->get_logger(), "%s", refused.what());
    return CallbackReturn::FAILURE;
  }
  for (int j = 0; j < monitor_->joints(); ++j)
    RCLCPP_INFO(get_node()->get_logger(), "%s/effort must be in %s", joints_[static_cast<std::size_t>(j)].c_str(),
                monitor_->torque_unit(j).c_str());
  if (contact_ && !monitor_->unmonitored(*contact_).empty())
    RCLCPP_INFO(get_node()->get_logger(), "%s", monitor_->unmonitored(*contact_).c_str());
  return CallbackReturn::SUCCESS;
}

void ToolForceSensor::load() {
  const auto node = get_node();
  const std::string path = node->get_parameter("bundle").as_string();
  if (path.empty()) throw tauext::Error("parameter bundle: the path of a bundle is missing");
  const tauext::Bundle bundle = tauext::load_bundle(path);
  monitor_.emplace(bundle);
  const tauext::WrenchModel& model = monitor_->wrench_model();
  if (!model.refused().empty()) throw tauext::Error(path + ": no force can be estimated, " + model.refused());

  std::string frame = node->get_parameter("frame").as_string();
  if (frame.empty()) frame = monitor_->load_settings().frame;
  frame_ = model.find(frame);
  if (frame_ < 0) {
    std::vector<std::string> known;
    for (int k = 0; k < model.frames(); ++k) known.push_back(model.frame(k).name);
    throw tauext::Error("parameter frame: '" + frame + "' must be one of " + listed(known));
  }

  const std::vector<double> point = node->get_parameter("point").as_double_array();
  if (!point.empty() && (point.size() != 3 || !std::ranges::all_of(point, [](double x) { return std::isfinite(x); })))
    throw tauext::Error("parameter point: must be three numbers, [m] along the frame's axes, or empty");
  point_.reset();
  if (!point.empty()) point_ = {point[0], point[1], point[2]};

  contact_.reset();
  tauext::DeclaredContact contact;
  contact.frame = frame_;
  if (point_) contact.point = *point_;
  contact.at_most_n = node->get_parameter("at_most_n").as_double();
  contact.at_most_nm = node->get_parameter("at_most_nm").as_double();
  if (contact.at_most_n != 0 || contact.at_most_nm != 0) {
    const std::string reason = monitor_->why_no_contact(contact, tauext::kAlways_s);
    if (!reason.empty()) throw tauext::Error("parameters at_most_n, at_most_nm: " + reason);
    contact_ = contact;
  }

  const auto n = static_cast<std::size_t>(monitor_->joints());
  joints_ = node->get_parameter("joints").as_string_array();
  if (joints_.empty())
    for (int j = 0; j < monitor_->joints(); ++j) joints_.push_back(monitor_->joint_name(j));
  if (joints_.size() != n)
    throw tauext::Error("parameter joints: " + listed(joints_) + ": must be " + std::to_string(n) +
                        " names, one for each joint of the bundle");

  // The monitor would report every sample as a fault.
  const double rate_hz = 1e9 / static_cast<double>(monitor_->sample_period_ns());
  if (std::fabs(get_update_rate() / rate_hz - 1) > bundle.signals.rate_tolerance)
    throw tauext::Error("parameter update_rate: " + std::to_string(get_update_rate()) + " Hz must be the bundle's " +
                        tauext::to_text(rate_hz) + " Hz");
  for (std::vector<double>* values : {&q_, &dq_, &tau_}) values->assign(n, kUnknown);
}

InterfaceConfiguration ToolForceSensor::command_interface_configuration() const {
  return {interface_configuration_type::NONE, {}};
}

InterfaceConfiguration ToolForceSensor::state_interface_configuration() const {
  InterfaceConfiguration wanted{interface_configuration_type::INDIVIDUAL, {}};
  for (const std::string& joint : joints_)
    for (const char* kind : kRead) wanted.names.push_back(joint + "/" + kind);
  return wanted;
}

std::vector<hardware_interface::StateInterface::SharedPtr> ToolForceSensor::on_export_state_interfaces_list() {
  exported_.clear();
  for (const char* name : kNames)
    exported_.push_back(std::make_shared<hardware_interface::StateInterface>(get_node()->get_name(), name));
  write(unknown<kExported>());
  return exported_;
}

std::vector<hardware_interface::CommandInterface::SharedPtr> ToolForceSensor::on_export_reference_interfaces_list() {
  return {};
}

bool ToolForceSensor::on_set_chained_mode(bool) { return true; }

CallbackReturn ToolForceSensor::on_activate(const rclcpp_lifecycle::State&) {
  const std::vector<std::string> wanted = state_interface_configuration().names;
  bool as_asked = state_interfaces_.size() == wanted.size();
  for (std::size_t k = 0; as_asked && k < wanted.size(); ++k) as_asked = state_interfaces_[k].get_name() == wanted[k];
  if (!as_asked) {
    RCLCPP_ERROR(get_node()->get_logger(), "the state interfaces must be %s", listed(wanted).c_str());
    return CallbackReturn::ERROR;
  }
  monitor_->reset();  // nothing is known of the time in between
  if (contact_) monitor_->expect_contact(*contact_, tauext::kAlways_s);
  return CallbackReturn::SUCCESS;
}

CallbackReturn ToolForceSensor::on_deactivate(const rclcpp_lifecycle::State&) {
  write(unknown<kExported>());
  return CallbackReturn::SUCCESS;
}

return_type ToolForceSensor::update_reference_from_subscribers(const rclcpp::Time&, const rclcpp::Duration&) {
  return return_type::OK;
}

return_type ToolForceSensor::update_and_write_commands(const rclcpp::Time& time, const rclcpp::Duration&) {
  const std::int64_t t_ns = time.nanoseconds();
  const tauext::Estimate& estimate = read_joints() ? monitor_->estimate({t_ns, q_, dq_, tau_}) : monitor_->no_sample(t_ns);
  constexpr auto axes = tauext::WrenchAxes::frame;
  const tauext::Wrench w = point_ ? monitor_->force(frame_, *point_, axes) : monitor_->wrench(frame_, axes);
  const auto step = static_cast<std::size_t>(w.unknowns + 1);  // along the diagonal
  const double error_n = std::sqrt(w.covariance[0] + w.covariance[step] + w.covariance[2 * step]);
  write({w.force[0], w.force[1], w.force[2], w.moment[0], w.moment[1], w.moment[2], error_n,
         static_cast<double>(estimate.health), static_cast<double>(estimate.held_alarm)});
  monitor_->advance();
  return return_type::OK;
}

bool ToolForceSensor::read_joints() {
  const std::array<std::vector<double>*, 3> into = {&q_, &dq_, &tau_};
  for (std::size_t k = 0; k < state_interfaces_.size(); ++k) {
    const std::optional<double> value = state_interfaces_[k].get_optional();
    if (!value) return false;
    (*into[k % 3])[k / 3] = *value;
  }
  return true;
}

void ToolForceSensor::write(const std::array<double, kExported>& values) {
  for (std::size_t k = 0; k < exported_.size(); ++k)
    for (int tries = 0; tries < kTries && !exported_[k]->set_value(values[k]); ++tries) std::this_thread::yield();
}

}  // namespace tauext_ros2_control

PLUGINLIB_EXPORT_CLASS(tauext_ros2_control::ToolForceSensor, controller_interface::ChainableControllerInterface)
