// A folder of this process alone. Fixed names in the system's temporary folder may belong to another user.
#pragma once
#include <filesystem>
#include <random>
#include <string>

class TemporaryFolder {
 public:
  TemporaryFolder() { std::filesystem::create_directory(path_); }
  ~TemporaryFolder() { std::filesystem::remove_all(path_); }
  TemporaryFolder(const TemporaryFolder&) = delete;
  TemporaryFolder& operator=(const TemporaryFolder&) = delete;

  std::string file(const char* name) const { return (path_ / name).string(); }

 private:
  std::filesystem::path path_ =
      std::filesystem::temp_directory_path() / ("tauext_test_" + std::to_string(std::random_device{}()));
};
