// Classes of the module `_engine` by topic.
#pragma once

#include <nanobind/nanobind.h>

namespace ekfslam {

void bind_gaussian(nanobind::module_& m);

}  // namespace ekfslam
