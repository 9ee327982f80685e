// Mock of rclcpp.
#pragma once
#include <cstdint>

namespace rclcpp {

class Duration {
 public:
  Duration(std::int32_t, std::uint32_t) {}
};

}  // namespace rclcpp
