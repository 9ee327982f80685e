# Wheels for 64-bit Arm; qemu runs the C++ tests (Debian packages qemu-user and libc6-arm64-cross).
set(wheel_processor aarch64)
include(${CMAKE_CURRENT_LIST_DIR}/manylinux.cmake)
set(CMAKE_CROSSCOMPILING_EMULATOR qemu-aarch64 -L /usr/aarch64-linux-gnu)
