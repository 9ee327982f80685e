// Mock of hardware_interface: interfaces by name, and what a controller borrows of one.
#pragma once
#include <memory>
#include <optional>
#include <string>
#include <utility>

namespace hardware_interface {

class Handle {
 public:
  explicit Handle(std::string prefix, std::string name, const std::string& = "double", const std::string& = "")
      : prefix_(std::move(prefix)), full_(prefix_ + "/" + name) {}
  const std::string& get_name() const { return full_; }
  const std::string& get_prefix_name() const { return prefix_; }
  template <typename T = double>
  [[nodiscard]] std::optional<T> get_optional() const {
    return held ? std::nullopt : std::optional<T>(value_);
  }
  template <typename T>
  [[nodiscard]] bool set_value(const T& value) {
    if (!held) value_ = value;
    return !held;
  }

  bool held = false;  // by another thread

 private:
  std::string prefix_, full_;
  double value_ = 0;
};

class StateInterface : public Handle {
 public:
  using Handle::Handle;
  using SharedPtr = std::shared_ptr<StateInterface>;
  using ConstSharedPtr = std::shared_ptr<const StateInterface>;
};

class CommandInterface : public Handle {
 public:
  using Handle::Handle;
  using SharedPtr = std::shared_ptr<CommandInterface>;
};

class LoanedStateInterface {
 public:
  explicit LoanedStateInterface(StateInterface::ConstSharedPtr of) : of_(std::move(of)) {}
  const std::string& get_name() const { return of_->get_name(); }
  template <typename T = double>
  [[nodiscard]] std::optional<T> get_optional(unsigned int = 10) const {
    return of_->get_optional<T>();
  }

 private:
  StateInterface::ConstSharedPtr of_;
};

}  // namespace hardware_interface
