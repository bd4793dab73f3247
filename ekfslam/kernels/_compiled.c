/* Kernels of a filter's frame on stacks of small matrices: the compiled form of ekfslam/kernels/plain.py.

   Every function takes C-contiguous arrays of double (or int64 for places), the results among them, and then sizes.
   Shapes are checked by ekfslam/kernels/compiled.py, which is the only caller. Sums are in a fixed order: results do not
   depend on the processor. */

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <math.h>
#include <stdint.h>
#include <string.h>

#define MOST_ROWS 8 /* rows of one landmark */
#define MOST_ARRAYS 12

typedef struct {
    Py_buffer view[MOST_ARRAYS];
    int held;
} Arrays;

static void release(Arrays *arrays)
{
    while (arrays->held)
        PyBuffer_Release(&arrays->view[--arrays->held]);
}

/* The first `count` arguments as buffers, the rest as sizes; 0 with an exception set where they are not. */
static int unpack(PyObject *const *args, Py_ssize_t given, int count, int sizes, Arrays *arrays, Py_ssize_t *size)
{
    arrays->held = 0;
    if (given != count + sizes) {
        PyErr_SetString(PyExc_TypeError, "wrong number of arguments");
        return 0;
    }
    for (int i = 0; i < count; i++) {
        if (PyObject_GetBuffer(args[i], &arrays->view[i], PyBUF_C_CONTIGUOUS)) {
            release(arrays);
            return 0;
        }
        arrays->held++;
    }
    for (int i = 0; i < sizes; i++) {
        size[i] = PyLong_AsSsize_t(args[count + i]);
        if (size[i] == -1 && PyErr_Occurred()) {
            release(arrays);
            return 0;
        }
    }
    return 1;
}

#define DOUBLE(i) ((double *)arrays.view[i].buf)
#define PLACES(i) ((const int64_t *)arrays.view[i].buf)

static PyObject *finished(Arrays *arrays, long failed)
{
    release(arrays);
    return PyLong_FromLong(failed);
}

/* --- one small matrix ------------------------------------------------------------------------------------------- */

/* Lower Cholesky factor of A (d, d), with zeros above; 0 where A is not positive definite. */
static int cholesky(int d, const double *A, double *L)
{
    for (int i = 0; i < d; i++) {
        for (int j = 0; j <= i; j++) {
            double sum = A[i * d + j];
            for (int c = 0; c < j; c++)
                sum -= L[i * d + c] * L[j * d + c];
            if (i == j) {
                if (!(sum > 0.0) || isinf(sum))
                    return 0;
                L[i * d + i] = sqrt(sum);
            } else
                L[i * d + j] = sum / L[j * d + j];
        }
        for (int j = i + 1; j < d; j++)
            L[i * d + j] = 0.0;
    }
    return 1;
}

/* Inverse of a lower triangle (d, d). */
static void invert_lower(int d, const double *L, double *inverse)
{
    memset(inverse, 0, sizeof(double) * d * d);
    for (int j = 0; j < d; j++) {
        inverse[j * d + j] = 1.0 / L[j * d + j];
        for (int i = j + 1; i < d; i++) {
            double sum = 0.0;
            for (int c = j; c < i; c++)
                sum -= L[i * d + c] * inverse[c * d + j];
            inverse[i * d + j] = sum / L[i * d + i];
        }
    }
}

/* C (m, p) = A (m, n) B (n, p). */
static void multiply(int m, int n, int p, const double *A, const double *B, double *C)
{
    for (int i = 0; i < m; i++)
        for (int j = 0; j < p; j++) {
            double sum = 0.0;
            for (int c = 0; c < n; c++)
                sum += A[i * n + c] * B[c * p + j];
            C[i * p + j] = sum;
        }
}

/* C (m, p) = A (m, n) B (p, n)^T. */
static void multiply_transposed(int m, int n, int p, const double *A, const double *B, double *C)
{
    for (int i = 0; i < m; i++)
        for (int j = 0; j < p; j++) {
            double sum = 0.0;
            for (int c = 0; c < n; c++)
                sum += A[i * n + c] * B[j * n + c];
            C[i * p + j] = sum;
        }
}

/* A (3, 3) M^T symmetrised after M A: S <- sym(M S M^T). */
static void congruent(const double *M, double *S)
{
    double MS[9], result[9];
    multiply(3, 3, 3, M, S, MS);
    multiply_transposed(3, 3, 3, MS, M, result);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            S[i * 3 + j] = 0.5 * (result[i * 3 + j] + result[j * 3 + i]);
}

/* A symmetric product of rows: out (d, d) = Z Z^T with Z (d, n). Four sums at once, which processors do in parallel. */
static void outer_square(int d, Py_ssize_t n, const double *Z, double *out)
{
    for (int a = 0; a < d; a++)
        for (int b = 0; b <= a; b++) {
            const double *x = Z + a * n, *y = Z + b * n;
            double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
            Py_ssize_t c = 0;
            for (; c + 4 <= n; c += 4) {
                s0 += x[c] * y[c];
                s1 += x[c + 1] * y[c + 1];
                s2 += x[c + 2] * y[c + 2];
                s3 += x[c + 3] * y[c + 3];
            }
            for (; c < n; c++)
                s0 += x[c] * y[c];
            out[a * d + b] = out[b * d + a] = (s0 + s1) + (s2 + s3);
        }
}

/* --- the conditional form --------------------------------------------------------------------------------------- */

/* whiten(K, S, row, H_x, H_m, variance, L, B, G, k, d, n, seen) */
static PyObject *whiten(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    Py_ssize_t size[4];
    if (!unpack(args, given, 9, 4, &arrays, size))
        return NULL;
    const Py_ssize_t k = size[0], n = size[2], seen = size[3];
    const int d = (int)size[1];
    long failed = 0;
    for (Py_ssize_t i = 0; i < k && !failed; i++) {
        const double *K = DOUBLE(0) + PLACES(2)[i] * 3 * n, *S = DOUBLE(1) + PLACES(2)[i] * 9;
        const double *H_x = DOUBLE(3) + i * d * seen, *H_m = DOUBLE(4) + i * d * 3, *variance = DOUBLE(5) + i * d;
        double *L = DOUBLE(6) + i * d * d, *B = DOUBLE(7) + i * d * n, *G = DOUBLE(8) + i * 3 * d;
        double S_H[3 * MOST_ROWS], R[MOST_ROWS * MOST_ROWS], inverse[MOST_ROWS * MOST_ROWS], A[3 * MOST_ROWS];
        multiply_transposed(3, 3, d, S, H_m, S_H);
        multiply(d, 3, d, H_m, S_H, R);
        for (int a = 0; a < d; a++)
            R[a * d + a] += variance[a];
        if (!cholesky(d, R, L)) {
            failed = 1;
            break;
        }
        invert_lower(d, L, inverse);
        multiply(d, d, 3, inverse, H_m, A);
        multiply_transposed(3, d, d, S_H, inverse, G);
        for (int a = 0; a < d; a++) {
            double *row = B + a * n;
            const double a0 = A[a * 3], a1 = A[a * 3 + 1], a2 = A[a * 3 + 2];
            for (Py_ssize_t c = 0; c < n; c++)
                row[c] = a0 * K[c] + a1 * K[n + c] + a2 * K[2 * n + c];
            for (int b = 0; b <= a; b++)
                for (Py_ssize_t c = 0; c < seen; c++)
                    row[c] += inverse[a * d + b] * H_x[b * seen + c];
        }
    }
    return finished(&arrays, failed);
}

/* own_variances(L, T, variance, out, k, d, f): L (T T^T + I) L^T - V */
static PyObject *own_variances(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    Py_ssize_t size[3];
    if (!unpack(args, given, 4, 3, &arrays, size))
        return NULL;
    const Py_ssize_t k = size[0], f = size[2];
    const int d = (int)size[1];
    for (Py_ssize_t i = 0; i < k; i++) {
        const double *L = DOUBLE(0) + i * d * d, *variance = DOUBLE(2) + i * d;
        double *out = DOUBLE(3) + i * d * d, square[MOST_ROWS * MOST_ROWS], left[MOST_ROWS * MOST_ROWS];
        outer_square(d, f, DOUBLE(1) + i * d * f, square);
        for (int a = 0; a < d; a++)
            square[a * d + a] += 1.0;
        multiply(d, d, d, L, square, left);
        multiply_transposed(d, d, d, left, L, out);
        for (int a = 0; a < d; a++)
            out[a * d + a] -= variance[a];
    }
    return finished(&arrays, 0);
}

/* given_others(L, Z, variance, out, k, d, f): V^1/2 L^-T (I - Z Z^T) L^-1 V^1/2 */
static PyObject *given_others(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    Py_ssize_t size[3];
    if (!unpack(args, given, 4, 3, &arrays, size))
        return NULL;
    const Py_ssize_t k = size[0], f = size[2];
    const int d = (int)size[1];
    for (Py_ssize_t i = 0; i < k; i++) {
        const double *variance = DOUBLE(2) + i * d;
        double *out = DOUBLE(3) + i * d * d, square[MOST_ROWS * MOST_ROWS], inverse[MOST_ROWS * MOST_ROWS],
               right[MOST_ROWS * MOST_ROWS];
        outer_square(d, f, DOUBLE(1) + i * d * f, square);
        for (int a = 0; a < d * d; a++)
            square[a] = -square[a];
        for (int a = 0; a < d; a++)
            square[a * d + a] += 1.0;
        invert_lower(d, DOUBLE(0) + i * d * d, inverse);
        multiply(d, d, d, square, inverse, right);
        for (int a = 0; a < d; a++)
            for (int b = 0; b < d; b++) {
                double sum = 0.0;
                for (int c = 0; c < d; c++)
                    sum += inverse[c * d + a] * right[c * d + b];
                out[a * d + b] = sum * (sqrt(variance[a]) * sqrt(variance[b]));
            }
    }
    return finished(&arrays, 0);
}

/* correct(K, S, row, B, G, which, k, d, n): K_row -= G B, S_row = sym(S_row - G G^T) of the j = k chosen landmarks */
static PyObject *correct(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    Py_ssize_t size[3];
    if (!unpack(args, given, 6, 3, &arrays, size))
        return NULL;
    const Py_ssize_t k = size[0], n = size[2];
    const int d = (int)size[1];
    for (Py_ssize_t j = 0; j < k; j++) {
        const int64_t i = PLACES(5)[j], row = PLACES(2)[i];
        double *K = DOUBLE(0) + row * 3 * n, *S = DOUBLE(1) + row * 9, square[9];
        const double *B = DOUBLE(3) + i * d * n, *G = DOUBLE(4) + i * 3 * d;
        for (int a = 0; a < 3; a++)
            for (int b = 0; b < d; b++) {
                const double g = G[a * d + b];
                for (Py_ssize_t c = 0; c < n; c++)
                    K[a * n + c] -= g * B[b * n + c];
            }
        multiply_transposed(3, d, 3, G, G, square);
        for (int a = 0; a < 3; a++)
            for (int b = 0; b <= a; b++)
                S[a * 3 + b] = S[b * 3 + a] =
                    0.5 * ((S[a * 3 + b] - square[a * 3 + b]) + (S[b * 3 + a] - square[b * 3 + a]));
    }
    return finished(&arrays, 0);
}

/* change(K, S, row, M, B, columns, k, n, c, has_M): K_row <- M K_row + B at the columns, S_row <- sym(M S_row M^T) */
static PyObject *change(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    Py_ssize_t size[4];
    if (!unpack(args, given, 6, 4, &arrays, size))
        return NULL;
    const Py_ssize_t k = size[0], n = size[1], columns = size[2];
    for (Py_ssize_t i = 0; i < k; i++) {
        double *K = DOUBLE(0) + PLACES(2)[i] * 3 * n;
        if (size[3]) {
            const double *M = DOUBLE(3) + i * 9;
            congruent(M, DOUBLE(1) + PLACES(2)[i] * 9);
            for (Py_ssize_t c = 0; c < n; c++) {
                const double x = K[c], y = K[n + c], z = K[2 * n + c];
                for (int a = 0; a < 3; a++)
                    K[a * n + c] = M[a * 3] * x + M[a * 3 + 1] * y + M[a * 3 + 2] * z;
            }
        }
        for (int a = 0; a < 3; a++)
            for (Py_ssize_t c = 0; c < columns; c++)
                K[a * n + PLACES(5)[c]] += DOUBLE(4)[(i * 3 + a) * columns + c];
    }
    return finished(&arrays, 0);
}

/* --- tests of innovations --------------------------------------------------------------------------------------- */

/* e^T A^-1 e by the Cholesky factor of A. */
static double square_through(int d, const double *L, const double *e)
{
    double white[MOST_ROWS], sum = 0.0;
    for (int a = 0; a < d; a++) {
        double left = e[a];
        for (int b = 0; b < a; b++)
            left -= L[a * d + b] * white[b];
        white[a] = left / L[a * d + a];
        sum += white[a] * white[a];
    }
    return sum;
}

/* normalised_squares(S, residual, out, k, d) */
static PyObject *normalised_squares(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    Py_ssize_t size[2];
    if (!unpack(args, given, 3, 2, &arrays, size))
        return NULL;
    const int d = (int)size[1];
    long failed = 0;
    for (Py_ssize_t i = 0; i < size[0] && !failed; i++) {
        double L[MOST_ROWS * MOST_ROWS];
        if (cholesky(d, DOUBLE(0) + i * d * d, L))
            DOUBLE(2)[i] = square_through(d, L, DOUBLE(1) + i * d);
        else
            failed = 1;
    }
    return finished(&arrays, failed);
}

/* Whether the smallest eigenvalue of A (d, d) exceeds `least`. */
static int exceeds(int d, const double *A, double least)
{
    double shifted[MOST_ROWS * MOST_ROWS], L[MOST_ROWS * MOST_ROWS];
    memcpy(shifted, A, sizeof(double) * d * d);
    for (int a = 0; a < d; a++)
        shifted[a * d + a] -= least;
    return cholesky(d, shifted, L);
}

/* squares_given_others(C, residual, variance, squares, judged, k, d) with judged as double; least is 1e-6 */
static PyObject *squares_given_others(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    Py_ssize_t size[2];
    if (!unpack(args, given, 5, 2, &arrays, size))
        return NULL;
    const int d = (int)size[1];
    for (Py_ssize_t i = 0; i < size[0]; i++) {
        const double *C = DOUBLE(0) + i * d * d;
        double L[MOST_ROWS * MOST_ROWS], e[MOST_ROWS];
        for (int a = 0; a < d; a++)
            e[a] = DOUBLE(1)[i * d + a] / sqrt(DOUBLE(2)[i * d + a]);
        const int judged = exceeds(d, C, 1e-6) && cholesky(d, C, L);
        DOUBLE(4)[i] = judged;
        DOUBLE(3)[i] = judged ? square_through(d, L, e) : 0.0;
    }
    return finished(&arrays, 0);
}

/* whitened(S, residual, out, k, d): NaN where S is singular */
static PyObject *whitened(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    Py_ssize_t size[2];
    if (!unpack(args, given, 3, 2, &arrays, size))
        return NULL;
    const int d = (int)size[1];
    for (Py_ssize_t i = 0; i < size[0]; i++) {
        const double *S = DOUBLE(0) + i * d * d, *residual = DOUBLE(1) + i * d;
        double std[MOST_ROWS], correlation[MOST_ROWS * MOST_ROWS], L[MOST_ROWS * MOST_ROWS], *out = DOUBLE(2) + i * d;
        for (int a = 0; a < d; a++)
            std[a] = sqrt(fmax(S[a * d + a], 2.2250738585072014e-308));
        for (int a = 0; a < d; a++)
            for (int b = 0; b < d; b++)
                correlation[a * d + b] = S[a * d + b] / (std[a] * std[b]);
        const int definite = exceeds(d, correlation, 1e-6) && cholesky(d, correlation, L);
        for (int a = 0; a < d; a++) {
            double left = residual[a] / std[a];
            for (int b = 0; b < a && definite; b++)
                left -= L[a * d + b] * out[b];
            out[a] = definite ? left / L[a * d + a] : NAN;
        }
    }
    return finished(&arrays, 0);
}

/* --- image coordinates of landmarks ----------------------------------------------------------------------------- */

/* (x/z, y/z, 1/z), its own inverse. */
static void image(const double *q, double *y)
{
    const double depth = q[2];
    y[0] = q[0] / depth;
    y[1] = q[1] / depth;
    y[2] = 1.0 / depth;
}

/* J v with J the derivative of the image, whose image y is given. */
static void image_by(const double *y, const double *v, double *out)
{
    for (int a = 0; a < 3; a++)
        out[a] = (a < 2 ? y[2] * v[a] : 0.0) - y[a] * y[2] * v[2];
}

/* moved_by_image(q, step, in_image, factor, after, n); in_image is double, and written */
static PyObject *moved_by_image(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    Py_ssize_t size[1];
    if (!unpack(args, given, 5, 1, &arrays, size))
        return NULL;
    const double factor = DOUBLE(3)[0];
    for (Py_ssize_t i = 0; i < size[0]; i++) {
        const double *q = DOUBLE(0) + 3 * i, *step = DOUBLE(1) + 3 * i;
        double *after = DOUBLE(4) + 3 * i, y[3], moved[3];
        if (DOUBLE(2)[i] != 0.0) {
            image(q, y);
            image_by(y, step, moved);
            for (int a = 0; a < 3; a++)
                moved[a] += y[a];
            if (moved[2] > y[2] / factor && moved[2] < y[2] * factor) {
                image(moved, after);
                continue;
            }
            DOUBLE(2)[i] = 0.0;
        }
        for (int a = 0; a < 3; a++)
            after[a] = q[a] + step[a];
    }
    return finished(&arrays, 0);
}

/* out (3, 3) += sign A q^, with q^ the matrix of the cross product */
static void add_crossed(const double *A, const double *q, double sign, double *out)
{
    for (int a = 0; a < 3; a++) {
        const double x = sign * A[3 * a], y = sign * A[3 * a + 1], z = sign * A[3 * a + 2];
        out[3 * a] += y * q[2] - z * q[1];
        out[3 * a + 1] += z * q[0] - x * q[2];
        out[3 * a + 2] += x * q[1] - y * q[0];
    }
}

/* change_by_image(q, q_linear, R, by, q_after, q_linear_after, R_after, by_after, in_image, B, M, n, c) */
static PyObject *change_by_image(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    Py_ssize_t size[2];
    if (!unpack(args, given, 11, 2, &arrays, size))
        return NULL;
    const Py_ssize_t columns = size[1];
    double back[9];
    for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++)
            back[3 * a + b] = DOUBLE(6)[3 * b + a];
    for (Py_ssize_t i = 0; i < size[0]; i++) {
        double J[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
        if (DOUBLE(8)[i] != 0.0) {
            double y[3], y_after[3], point[3];
            image(DOUBLE(0) + 3 * i, y);
            image(DOUBLE(4) + 3 * i, y_after);
            image(y_after, point);
            for (int b = 0; b < 3; b++) {
                double axis[3] = {b == 0, b == 1, b == 2}, by[3], column[3];
                image_by(y, axis, by);
                image_by(point, by, column);
                for (int a = 0; a < 3; a++)
                    J[3 * a + b] = column[a];
            }
        }
        double left[9], left_turn[9] = {0}, right_turn[9] = {0}, *B = DOUBLE(9) + i * 3 * columns;
        multiply(3, 3, 3, back, J, left);
        add_crossed(left, DOUBLE(1) + 3 * i, -1.0, left_turn);
        add_crossed(back, DOUBLE(5) + 3 * i, 1.0, right_turn);
        multiply(3, 3, 3, left, DOUBLE(2), DOUBLE(10) + 9 * i);
        for (int a = 0; a < 3; a++)
            for (Py_ssize_t c = 0; c < columns; c++) {
                double sum = 0.0;
                for (int b = 0; b < 3; b++)
                    sum += left[3 * a + b] * DOUBLE(3)[b * columns + c] - back[3 * a + b] * DOUBLE(7)[b * columns + c] +
                           left_turn[3 * a + b] * DOUBLE(3)[(b + 3) * columns + c] +
                           right_turn[3 * a + b] * DOUBLE(7)[(b + 3) * columns + c];
                B[a * columns + c] = sum;
            }
    }
    return finished(&arrays, 0);
}

/* --- one pose --------------------------------------------------------------------------------------------------- */

/* phi_0 to phi_5 at theta^2, see ekfslam/geometry/se3.py */
static void phis(double x, double *phi)
{
    if (x <= 2.0) {
        /* 1 / (2n + 4)! and 1 / (2n + 5)!, n from 9 to 0 */
        double factorial_4 = 1.1240007277776077e+21, factorial_5 = 2.5852016738884978e+22, phi_4 = 0.0, phi_5 = 0.0;
        for (int n = 9; n >= 0; n--) {
            phi_4 = 1.0 / factorial_4 - x * phi_4;
            phi_5 = 1.0 / factorial_5 - x * phi_5;
            factorial_4 /= (double)((2 * n + 4) * (2 * n + 3));
            factorial_5 /= (double)((2 * n + 5) * (2 * n + 4));
        }
        phi[4] = phi_4;
        phi[5] = phi_5;
        phi[2] = 0.5 - x * phi_4;
        phi[3] = 1.0 / 6.0 - x * phi_5;
        phi[0] = 1.0 - x * phi[2];
        phi[1] = 1.0 - x * phi[3];
    } else {
        const double theta = sqrt(x);
        double factorial = 1.0;
        phi[0] = cos(theta);
        phi[1] = sin(theta) / theta;
        for (int k = 0; k < 4; k++) {
            factorial = k ? factorial * k : 1.0;
            phi[k + 2] = (1.0 / factorial - phi[k]) / x;
        }
    }
}

static void skew(const double *v, double *out)
{
    const double filled[9] = {0.0, -v[2], v[1], v[2], 0.0, -v[0], -v[1], v[0], 0.0};
    memcpy(out, filled, sizeof filled);
}

/* Rotation and left Jacobian of a rotation vector. */
static void rotation(const double *theta, const double *phi, double *R, double *J)
{
    double w[9], ww[9];
    skew(theta, w);
    multiply(3, 3, 3, w, w, ww);
    for (int a = 0; a < 9; a++) {
        const double one = a % 4 == 0;
        R[a] = one + phi[1] * w[a] + phi[2] * ww[a];
        J[a] = one + phi[2] * w[a] + phi[3] * ww[a];
    }
}

static double angle_squared(const double *theta)
{
    return theta[0] * theta[0] + theta[1] * theta[1] + theta[2] * theta[2];
}

/* so3_exp_and_left_jacobian(theta, R, J) */
static PyObject *so3_exp_and_left_jacobian(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    if (!unpack(args, given, 3, 0, &arrays, NULL))
        return NULL;
    double phi[6];
    phis(angle_squared(DOUBLE(0)), phi);
    rotation(DOUBLE(0), phi, DOUBLE(1), DOUBLE(2));
    return finished(&arrays, 0);
}

/* The transform [R t; 0 1]. */
static void transform(const double *R, const double *t, double *T)
{
    for (int a = 0; a < 3; a++) {
        for (int b = 0; b < 3; b++)
            T[4 * a + b] = R[3 * a + b];
        T[4 * a + 3] = t[a];
        T[12 + a] = 0.0;
    }
    T[15] = 1.0;
}

/* exp(xi, T) */
static PyObject *exp_of_tangent(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    if (!unpack(args, given, 2, 0, &arrays, NULL))
        return NULL;
    double phi[6], R[9], J[9], t[3];
    phis(angle_squared(DOUBLE(0) + 3), phi);
    rotation(DOUBLE(0) + 3, phi, R, J);
    multiply(3, 3, 1, J, DOUBLE(0), t);
    transform(R, t, DOUBLE(1));
    return finished(&arrays, 0);
}

/* inverse(T, out) */
static PyObject *inverse(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    if (!unpack(args, given, 2, 0, &arrays, NULL))
        return NULL;
    const double *T = DOUBLE(0);
    double R[9], t[3];
    for (int a = 0; a < 3; a++) {
        for (int b = 0; b < 3; b++)
            R[3 * a + b] = T[4 * b + a];
        t[a] = -(R[3 * a] * T[3] + R[3 * a + 1] * T[7] + R[3 * a + 2] * T[11]);
    }
    transform(R, t, DOUBLE(1));
    return finished(&arrays, 0);
}

/* [A B; 0 A] */
static void blocks(const double *A, const double *B, double *out)
{
    for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++) {
            out[6 * a + b] = out[6 * (a + 3) + b + 3] = A[3 * a + b];
            out[6 * a + b + 3] = B[3 * a + b];
            out[6 * (a + 3) + b] = 0.0;
        }
}

/* adjoint(T, out) */
static PyObject *adjoint(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    if (!unpack(args, given, 2, 0, &arrays, NULL))
        return NULL;
    const double *T = DOUBLE(0), t[3] = {T[3], T[7], T[11]};
    double R[9], moved[9], corner[9];
    for (int a = 0; a < 9; a++)
        R[a] = T[4 * (a / 3) + a % 3];
    skew(t, moved);
    multiply(3, 3, 3, moved, R, corner);
    blocks(R, corner, DOUBLE(1));
    return finished(&arrays, 0);
}

/* left_jacobian(xi, out) */
static PyObject *left_jacobian(PyObject *self, PyObject *const *args, Py_ssize_t given)
{
    Arrays arrays;
    if (!unpack(args, given, 2, 0, &arrays, NULL))
        return NULL;
    double phi[6], R[9], J[9], corner[9], rho[9], theta[9];
    double theta_rho[9], rho_theta[9], sandwich[9], a[9], b[9], c[9], d[9];
    phis(angle_squared(DOUBLE(0) + 3), phi);
    rotation(DOUBLE(0) + 3, phi, R, J);
    skew(DOUBLE(0), rho);
    skew(DOUBLE(0) + 3, theta);
    multiply(3, 3, 3, theta, rho, theta_rho);
    multiply(3, 3, 3, rho, theta, rho_theta);
    multiply(3, 3, 3, theta_rho, theta, sandwich);
    multiply(3, 3, 3, theta, theta_rho, a);
    multiply(3, 3, 3, rho_theta, theta, b);
    multiply(3, 3, 3, sandwich, theta, c);
    multiply(3, 3, 3, theta, sandwich, d);
    for (int i = 0; i < 9; i++)
        corner[i] = 0.5 * rho[i] + phi[3] * (theta_rho[i] + rho_theta[i] + sandwich[i]) +
                    phi[4] * (a[i] + b[i] - 3.0 * sandwich[i]) + 0.5 * (phi[4] - 3.0 * phi[5]) * (c[i] + d[i]);
    blocks(J, corner, DOUBLE(1));
    return finished(&arrays, 0);
}

static PyMethodDef methods[] = {
    {"so3_exp_and_left_jacobian", (PyCFunction)(void (*)(void))so3_exp_and_left_jacobian, METH_FASTCALL, NULL},
    {"exp", (PyCFunction)(void (*)(void))exp_of_tangent, METH_FASTCALL, NULL},
    {"inverse", (PyCFunction)(void (*)(void))inverse, METH_FASTCALL, NULL},
    {"adjoint", (PyCFunction)(void (*)(void))adjoint, METH_FASTCALL, NULL},
    {"left_jacobian", (PyCFunction)(void (*)(void))left_jacobian, METH_FASTCALL, NULL},
    {"moved_by_image", (PyCFunction)(void (*)(void))moved_by_image, METH_FASTCALL, NULL},
    {"change_by_image", (PyCFunction)(void (*)(void))change_by_image, METH_FASTCALL, NULL},
    {"whiten", (PyCFunction)(void (*)(void))whiten, METH_FASTCALL, NULL},
    {"own_variances", (PyCFunction)(void (*)(void))own_variances, METH_FASTCALL, NULL},
    {"given_others", (PyCFunction)(void (*)(void))given_others, METH_FASTCALL, NULL},
    {"correct", (PyCFunction)(void (*)(void))correct, METH_FASTCALL, NULL},
    {"change", (PyCFunction)(void (*)(void))change, METH_FASTCALL, NULL},
    {"normalised_squares", (PyCFunction)(void (*)(void))normalised_squares, METH_FASTCALL, NULL},
    {"squares_given_others", (PyCFunction)(void (*)(void))squares_given_others, METH_FASTCALL, NULL},
    {"whitened", (PyCFunction)(void (*)(void))whitened, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_compiled", NULL, -1, methods, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__compiled(void) { return PyModule_Create(&module); }
