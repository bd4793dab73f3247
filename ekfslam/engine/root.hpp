// A root of a covariance that may be singular, and regression by it.
#pragma once

#include "types.hpp"

namespace ekfslam {

// P = F F^T with F (n, f): upper triangular if P is regular, else of the rank of P.
class Root {
   public:
    // Directions whose variance is but rounding of the variances `of` (n), by default those of P, count as zero.
    explicit Root(const Matrix& P) : Root(P, P.diagonal()) {}
    Root(const Matrix& P, const Vector& of);

    Matrix F;
    bool regular = true;

    // F_o (o, f) with P_oA = F_o F^T, for the covariance P_oA (o, n) of further columns with these.
    Matrix coefficients(const Matrix& P_oA) const;
    // C (o, n) with C F = F_o: the regression x_o = C x_A + eps, eps of covariance P_oo - F_o F_o^T.
    Matrix regression(const Matrix& F_o) const;

   private:
    void pivot(const Matrix& P, const Vector& of);
    Slots pivots_;  // if singular: rows of F that are lower triangular
    Matrix L_;      // those rows
};

// For upper triangular F and W, which stay so: W <- F C^-T with lower triangular C, and the lower triangle of W W^T.
// Recursion spares two thirds of the arithmetic of BLAS, which knows one of the two triangles alone.
void divide_upper(Eigen::Ref<Matrix> F, const Eigen::Ref<const Matrix>& C);
void square_upper(const Eigen::Ref<const Matrix>& W, Eigen::Ref<Matrix> P);

}  // namespace ekfslam
