// Mock of rclcpp: messages go to stderr.
#pragma once
#include <cstdio>

namespace rclcpp {

class Logger {};

}  // namespace rclcpp

#define MOCK_LOG(level, logger, ...)               \
  do {                                             \
    static_cast<void>(logger);                     \
    std::fprintf(stderr, "[" level "] " __VA_ARGS__); \
    std::fputc('\n', stderr);                      \
  } while (false)
#define RCLCPP_INFO(logger, ...) MOCK_LOG("INFO", logger, __VA_ARGS__)
#define RCLCPP_ERROR(logger, ...) MOCK_LOG("ERROR", logger, __VA_ARGS__)
