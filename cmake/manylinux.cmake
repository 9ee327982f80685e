# Compiler of the wheels, for both processors: zig's clang with its own C++ library linked in, against glibc 2.28, the
# oldest system that manylinux_2_28 promises to run on. `make dist` has it on the PATH as python-zig (package ziglang).
# The file that includes this one sets wheel_processor; where it is this machine's own, nothing is cross-compiled.
if(NOT wheel_processor STREQUAL CMAKE_HOST_SYSTEM_PROCESSOR)
  set(CMAKE_SYSTEM_NAME Linux)
  set(CMAKE_SYSTEM_PROCESSOR ${wheel_processor})
endif()
find_program(TAUEXT_ZIG NAMES python-zig zig REQUIRED)
list(APPEND CMAKE_TRY_COMPILE_PLATFORM_VARIABLES TAUEXT_ZIG)
set(zig_target ${wheel_processor}-linux-gnu.2.28)
# zig adds checks for undefined behaviour to a build without -O; no build of ours is one, but CMake's first tries are.
set(CMAKE_C_COMPILER ${TAUEXT_ZIG} cc -target ${zig_target} -fno-sanitize=all)
set(CMAKE_CXX_COMPILER ${TAUEXT_ZIG} c++ -target ${zig_target} -fno-sanitize=all)
set(CMAKE_CXX_COMPILER_LAUNCHER "${CMAKE_CURRENT_LIST_DIR}/zig_header.sh")
# nanobind writes to stderr and, with the stable ABI and this C++ library, nobody includes where that is declared.
set(CMAKE_CXX_FLAGS_INIT "-include cstdio")
# Debian's Python includes headers from a folder of the processor below this one, which zig does not search.
if(wheel_processor STREQUAL CMAKE_HOST_SYSTEM_PROCESSOR)
  string(APPEND CMAKE_CXX_FLAGS_INIT " -idirafter /usr/include")
endif()
# The system's `ar` knows one processor only.
foreach(language C CXX)
  set(CMAKE_${language}_ARCHIVE_CREATE "\"${TAUEXT_ZIG}\" ar qc <TARGET> <LINK_FLAGS> <OBJECTS>")
  set(CMAKE_${language}_ARCHIVE_APPEND "\"${TAUEXT_ZIG}\" ar q <TARGET> <LINK_FLAGS> <OBJECTS>")
  set(CMAKE_${language}_ARCHIVE_FINISH "\"${TAUEXT_ZIG}\" ranlib <TARGET>")
endforeach()
