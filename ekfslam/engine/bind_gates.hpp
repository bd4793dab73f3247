// Gates and consensus in Python.
#pragma once

#include <nanobind/nanobind.h>

namespace ekfslam {

void bind_gates(nanobind::module_& m);

}  // namespace ekfslam
