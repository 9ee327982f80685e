# Wheels for x86-64.
set(wheel_processor x86_64)
include(${CMAKE_CURRENT_LIST_DIR}/manylinux.cmake)
