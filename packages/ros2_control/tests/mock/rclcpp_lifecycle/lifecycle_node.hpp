// Mock of rclcpp_lifecycle: a node that is its name and its parameters.
#pragma once
#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <variant>
#include <vector>

#include "rclcpp/logging.hpp"
#include "rclcpp_lifecycle/state.hpp"

namespace rclcpp {

class Parameter {
 public:
  using Value = std::variant<std::string, double, std::vector<double>, std::vector<std::string>>;

  explicit Parameter(Value value) : value_(std::move(value)) {}
  std::string as_string() const { return std::get<std::string>(value_); }
  double as_double() const { return std::get<double>(value_); }
  std::vector<double> as_double_array() const { return std::get<std::vector<double>>(value_); }
  std::vector<std::string> as_string_array() const { return std::get<std::vector<std::string>>(value_); }

 private:
  Value value_;
};

}  // namespace rclcpp

namespace rclcpp_lifecycle {

namespace node_interfaces {

class LifecycleNodeInterface {
 public:
  enum class CallbackReturn { SUCCESS, FAILURE, ERROR };

  virtual ~LifecycleNodeInterface() = default;
  virtual CallbackReturn on_configure(const State&) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_activate(const State&) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_deactivate(const State&) { return CallbackReturn::SUCCESS; }
};

}  // namespace node_interfaces

class LifecycleNode {
 public:
  using Parameters = std::map<std::string, rclcpp::Parameter::Value>;

  LifecycleNode(std::string name, Parameters overrides) : name_(std::move(name)), overrides_(std::move(overrides)) {}
  const char* get_name() const { return name_.c_str(); }
  rclcpp::Logger get_logger() const { return {}; }
  void declare(const std::string& name, const rclcpp::Parameter::Value& value) {
    const auto own = overrides_.find(name);
    if (own != overrides_.end() && own->second.index() != value.index())
      throw std::runtime_error("parameter '" + name + "' has invalid type");
    parameters_[name] = own == overrides_.end() ? value : own->second;
  }
  rclcpp::Parameter get_parameter(const std::string& name) const { return rclcpp::Parameter(parameters_.at(name)); }

 private:
  std::string name_;
  Parameters overrides_, parameters_;
};

}  // namespace rclcpp_lifecycle
