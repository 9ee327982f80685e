// Mock of rclcpp: what tool_force_sensor.cpp calls, with the signatures of ROS 2.
#pragma once
#include <cstdint>

namespace rclcpp {

class Time {
 public:
  explicit Time(std::int64_t ns) : ns_(ns) {}
  std::int64_t nanoseconds() const { return ns_; }

 private:
  std::int64_t ns_;
};

}  // namespace rclcpp
