"""Visual-inertial EKF-SLAM with a joint map-and-pose covariance that can be trusted.

    import ekfslam

    sequence = ekfslam.open_sequence("builtin:city")
    result = ekfslam.run(sequence, mode="full")
    result.T_world_imu, result.covariance, result.landmarks.position_m
    result.map(sequence), result.to_dataframe("landmarks")
    everything = ekfslam.posterior(result)   # smoothed: all poses, all landmarks, any block of their covariance

Conventions, everywhere:

- ``T_a_b`` maps coordinates of frame b into frame a, ``p_a = T_a_b p_b``. Frames: ``world``, ``imu`` (x forward in a
  car), ``cam`` (left optical frame: x right, y down, z forward). The report's inverse IMU pose is ``T_imu_world``.
- Tangent vectors are translation first: twist ``u = [v; w]`` (m/s, rad/s, IMU frame), pose error ``xi = [rho; theta]``.
- Errors: ``T_imu_world = exp(xi^) T_hat``, landmark ``m = m_hat + d`` (world, metres). Covariances are of ``(xi, d)``
  in every variant of the filter. `Result.position_covariance_world` is along the axes of world.
- ``twist[k]`` at stamp ``t[k]`` drives the interval ``(t[k-1], t[k]]``.
- ``V`` is pixel noise, ``R`` a rotation. Names carry units if a reader could doubt them (``_s``, ``_px``, ``_m``).

Equations (docstrings cite these numbers)::

    E = exp(-tau u^)                      T+ = E T                                   (1) prediction
    F = Ad_E                              Q = tau^2 J_l(-tau u) W J_l(-tau u)^T      (2) its covariance
    q = T_cam_imu T_imu_world m           z = M pi(q) = (uL, vL, uR, vR)             (3) stereo model
    A = M dpi/dq R_cam_imu                s = T_imu_world m
    H = [ A [I, -s^] | A C ]              C = rotation of T_imu_world                (4) 6+3 columns a landmark
    m_hat = T^-1 q(z),  G = -C^T [I, -s^],  P_m: = G P_x:,
    P_mm = G P_xx G^T + C^T (A^T V^-1 A)^-1 C                                        (5) new landmark
    S = H P H^T + V = L L^T,  Y = L^-1 H P,  (xi, d) = Y^T L^-1 r,  P -= Y^T Y       (6) update
    e_theta = -C^T xi_theta,  e_i = d_i + m_i^ e_theta,
    T+ = exp(xi) T,  m_i+ = exp(e_theta) m_i + J_l(e_theta) e_i,  P+ = J P J^T       (7) invariant retraction
    W = T_cam_world,  W_true = exp(z^) W,  z = Y x,  y = f(q) = (x/z, y/z, 1/z),  q = W m,  J = df/dq,
    m_i+ = (W+)^-1 f^-1(y_i + J_i ([I, -q_i^] z + R_W d_i)),                          (7') landmarks as images
    d_i+ = M_i d_i + B_i z,  M = R_W+^T J+^-1 J R_W,  B = R_W+^T (J+^-1 J [I, -q^] - [I, -q+^] D),
    xi+ = Ad(T+ T^-1) xi (invariant) or xi,  z+ = D z,  D = Ad(W+ W^-1) or 1,  P+ = G P G^T
    u = diag(R, R) u_level,  R = [x, up^ x, up],  x ~ forward - (forward . up) up    (8) velocities over level ground
    q = exp(c^) T_cam_imu exp(-c_time u^) T_imu_world m                              (9) calibration in the state
    z(k) = h(k) + e(k),  e(k) = f e(k-1) + w,  hence
    z(k) - f z(k-1) = h(k) - f h(k-1) + w  over frame k, view k-1 and landmark       (10) errors of tracks
    q = T_cam_imu exp((n + l b)^) T_imu_world m, l the way in z(k) of a difference (10),
    else 0                                                                           (11) errors that landmarks share
    R1 = R0 dR,  v1 = v0 + g tau + R0 dv,  p1 = p0 + v0 tau + g tau^2 / 2 + R0 dp,  u1 = R1^T v1,
    F = S(u1)^-1 Phi S(u0),  Q = S(u1)^-1 Q_z S(u1)^-T                               (12) inertial samples
    mean f_m = -C g + ba + n,  mean w_m = bg + n,  u = 0                             (13) inertial start at rest
    r = [log(T1 f(T0)^-1); u1 - f_u; b1 - b0], f the step (12)                       (14) residual of an interval

Glossary:

- *state block*: a part of the state other than landmarks: pose, twist, up, calibration, ... (`ekfslam.models.blocks`).
- *body*: all blocks; *layout*: the columns of each block in the covariance.
- *input*: velocities or inertial samples of a recording; *process*: the model that moves blocks by them
  (`ekfslam.models.process`).
- *sensor*: a model of observations of landmarks (`ekfslam.models.sensors`); its *rows* are an observation's numbers.
- *landmark initialisation*: eq. (5). A *delayed* one waits for a second view.
- *innovation*: measured rows minus predicted ones; *gate*: the chi-square limit on its normalised square.
- *shared innovation*: the motion of the camera on which all innovations of a frame agree; white if the model is true.
- *NIS*, *NEES*: normalised innovation or estimation error squared. A covariance is *consistent*, or honest, if their
  means are their degrees of freedom.
- *truth noise*: the errors of the true poses (`ekfslam.data.truth_noise`); *relative* NEES: that of the motion between
  two reported poses (`ekfslam.evaluation.relative`), independent of the error of the first.
- *considered*: in the covariance, but never corrected (`ekfslam.filters.references`).
- *variant*: linearisation point of the joint filter, and action of a correction: invariant, fej, standard.
- *view*: the camera of a frame in world, W, with one error z for all that moves it (`ekfslam.models.blocks.view`).
- *image coordinates*: (7') for landmarks, W the last updated view; else *xyz*.
- *gauge*: directions that no observation depends on: position and heading of the world, with (1) its whole rotation.
- *track*: observations under one id; *hygiene*: cutting and dropping tracks before an estimator uses them.
- *retire*: marginalise a landmark out of view; *dormant*: out of view, but still in the state; *map revival*: bring a
  retired landmark back from the batch problem.
- *batch problem*: all rows of a log over all frames and landmarks; *posterior*: its Gaussian.
- *as filtered*: rows frozen at the filter's linearisation; *map*: relinearised at the maximum a posteriori.
- *coordinates* of a block: the sum of its corrections; those of vectors are their values.
- *standard deviation*: of a Gaussian error, always one sigma.
"""

# `__init__.pyi` lists the names. They are imported on first use, so that `import ekfslam` is fast.
import lazy_loader as _lazy

_from_stub, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("ekfslam")
    return _from_stub(name)
