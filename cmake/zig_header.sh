#!/bin/sh
# Runs a compile command of CMake's. zig precompiles a header only where neither -c nor -emit-pch is among the options.
case " $* " in
*" c++-header "*)
  emit=
  for word in "$@"; do
    shift
    case $word in
    -c) continue ;;
    -Xclang) emit=$word; continue ;;
    -emit-pch) emit=; continue ;;
    esac
    set -- "$@" ${emit:+"$emit"} "$word"
    emit=
  done
  ;;
esac
exec "$@"
