// BLAS and LAPACK of SciPy by pointer: the same routines as those of NumPy's users, without linking against any.
#pragma once

namespace ekfslam::lapack {

extern void (*dgemm)(char* transa, char* transb, int* m, int* n, int* k, double* alpha, double* a, int* lda, double* b,
                     int* ldb, double* beta, double* c, int* ldc);
extern void (*dsyrk)(char* uplo, char* trans, int* n, int* k, double* alpha, double* a, int* lda, double* beta,
                     double* c, int* ldc);
extern void (*dtrsm)(char* side, char* uplo, char* transa, char* diag, int* m, int* n, double* alpha, double* a,
                     int* lda, double* b, int* ldb);
extern void (*dtrmm)(char* side, char* uplo, char* transa, char* diag, int* m, int* n, double* alpha, double* a,
                     int* lda, double* b, int* ldb);
extern void (*dgemv)(char* trans, int* m, int* n, double* alpha, double* a, int* lda, double* x, int* incx,
                     double* beta, double* y, int* incy);
extern void (*dpotrf)(char* uplo, int* n, double* a, int* lda, int* info);
extern void (*dpotri)(char* uplo, int* n, double* a, int* lda, int* info);
extern void (*dpstrf)(char* uplo, int* n, double* a, int* lda, int* piv, int* rank, double* tol, double* work,
                      int* info);

// A routine and the signature that Cython gives it, as in `void (char *, int *, ..._d *)`.
struct Found {
    void* routine = nullptr;
    const char* signature = nullptr;
};

// Fills all pointers above; `find` looks a routine up in a module of SciPy. Throws std::runtime_error that names the
// routine that is missing or takes other arguments, such as 64-bit integers.
void load(Found (*find)(const char* module, const char* name));

}  // namespace ekfslam::lapack
