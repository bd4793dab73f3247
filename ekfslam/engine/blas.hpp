// Products and triangular solves of Eigen matrices by BLAS, in place; matrices without rows or columns are allowed.
#pragma once

#include "lapack.hpp"
#include "types.hpp"

namespace ekfslam::blas {

using Part = Eigen::Ref<Matrix>;
using Given = Eigen::Ref<const Matrix>;

inline double* data(const Given& A) { return const_cast<double*>(A.data()); }
inline int size(Index n) { return static_cast<int>(n); }
inline int stride(const Given& A) { return size(std::max<Index>(A.outerStride(), 1)); }

// Floating point operations of all calls so far in this thread; own loops over 3 x 3 and 6 x 6 blocks are not counted.
inline double& flops() {
    static thread_local double counted = 0.0;
    return counted;
}

// C <- alpha op(A) op(B) + beta C, op by 'N' or 'T'.
inline void multiply(char a, char b, double alpha, const Given& A, const Given& B, double beta, Part C) {
    int m = size(C.rows()), n = size(C.cols()), k = size(a == 'N' ? A.cols() : A.rows());
    int lda = stride(A), ldb = stride(B), ldc = stride(C);
    flops() += 2.0 * m * n * k;
    if (m && n) lapack::dgemm(&a, &b, &m, &n, &k, &alpha, data(A), &lda, data(B), &ldb, &beta, C.data(), &ldc);
}

// A triangle of C <- alpha op(A) op(A)^T + beta C, 'L' or 'U'.
inline void square(char triangle, char a, double alpha, const Given& A, double beta, Part C) {
    int n = size(C.rows()), k = size(a == 'N' ? A.cols() : A.rows()), lda = stride(A), ldc = stride(C);
    flops() += 1.0 * n * n * k;
    if (n && k)
        lapack::dsyrk(&triangle, &a, &n, &k, &alpha, data(A), &lda, &beta, C.data(), &ldc);
    else if (n && beta != 1.0)
        C *= beta;
}

// Its lower triangle.
inline void square(char a, double alpha, const Given& A, double beta, Part C) { square('L', a, alpha, A, beta, C); }

// B <- op(A)^-1 B (side 'L') or B op(A)^-1 ('R') for triangular A.
inline void solve(char side, char triangle, char a, const Given& A, Part B) {
    char diagonal = 'N';
    double one = 1.0;
    int m = size(B.rows()), n = size(B.cols()), lda = stride(A), ldb = stride(B);
    flops() += 1.0 * m * n * (side == 'L' ? m : n);
    if (m && n) lapack::dtrsm(&side, &triangle, &a, &diagonal, &m, &n, &one, data(A), &lda, B.data(), &ldb);
}

// B <- op(A) B (side 'L') or B op(A) ('R') for triangular A.
inline void multiply_triangle(char side, char triangle, char a, const Given& A, Part B) {
    char diagonal = 'N';
    double one = 1.0;
    int m = size(B.rows()), n = size(B.cols()), lda = stride(A), ldb = stride(B);
    flops() += 1.0 * m * n * (side == 'L' ? m : n);
    if (m && n) lapack::dtrmm(&side, &triangle, &a, &diagonal, &m, &n, &one, data(A), &lda, B.data(), &ldb);
}

// Lower Cholesky factor in place; false if A is not positive definite. The upper triangle is not touched.
inline bool factorise(Part A) {
    char lower = 'L';
    int n = size(A.rows()), lda = stride(A), failed = 0;
    flops() += 1.0 * n * n * n / 3.0;
    if (n) lapack::dpotrf(&lower, &n, A.data(), &lda, &failed);
    return failed == 0 && A.diagonal().allFinite();
}

// op(A) x.
inline Vector multiply(char a, const Given& A, const Vector& x) {
    int m = size(A.rows()), n = size(A.cols()), lda = stride(A), step = 1;
    double one = 1.0, zero = 0.0;
    flops() += 2.0 * m * n;
    Vector y = Vector::Zero(a == 'N' ? A.rows() : A.cols());
    if (m && n)
        lapack::dgemv(&a, &m, &n, &one, data(A), &lda, const_cast<double*>(x.data()), &step, &zero, y.data(), &step);
    return y;
}

// Copies the lower triangle to the upper one.
inline void mirror(Part A) {
    constexpr Index block = 32;
    for (Index begin = 0; begin < A.rows(); begin += block) {
        const Index end = std::min(begin + block, A.rows()), below = A.rows() - end;
        for (Index j = begin; j < end; ++j)
            for (Index i = j + 1; i < end; ++i) A(j, i) = A(i, j);
        A.block(begin, end, end - begin, below) = A.block(end, begin, below, end - begin).transpose();
    }
}

}  // namespace ekfslam::blas
