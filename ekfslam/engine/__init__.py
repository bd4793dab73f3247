"""The filter in C++: the same equations as `ekfslam.filters`, several times faster."""
