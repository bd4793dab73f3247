#include "lapack.hpp"

#include <stdexcept>
#include <string>

namespace ekfslam::lapack {

decltype(dgemm) dgemm = nullptr;
decltype(dsyrk) dsyrk = nullptr;
decltype(dtrsm) dtrsm = nullptr;
decltype(dtrmm) dtrmm = nullptr;
decltype(dgemv) dgemv = nullptr;
decltype(dpotrf) dpotrf = nullptr;
decltype(dpotri) dpotri = nullptr;
decltype(dpstrf) dpstrf = nullptr;

namespace {

// The arguments of a signature in short: c for char *, i for int *, d for double *, ? for any other.
std::string shortened(const std::string& signature) {
    std::string letters;
    std::size_t from = signature.find('(');
    while (from < signature.size()) {
        const std::size_t start = from + (signature[from] == '(' ? 1 : 2);
        const std::size_t end = signature.find_first_of(",)", start);
        if (end == std::string::npos) break;
        const std::string argument = signature.substr(start, end - start);
        const bool is_double =
            argument == "double *" || (argument.size() > 4 && argument.rfind("_d *") == argument.size() - 4);
        letters += argument == "char *" ? 'c' : argument == "int *" ? 'i' : is_double ? 'd' : '?';
        from = signature[end] == ')' ? signature.size() : end;
    }
    return letters;
}

template <class Routine>
void fill(Routine& pointer, Found (*find)(const char*, const char*), const char* module, const char* name,
          const char* arguments) {
    const Found found = find(module, name);
    const std::string full = std::string(module) + "." + name;
    if (found.routine == nullptr) throw std::runtime_error("the engine needs " + full + ", which this SciPy lacks");
    if (found.signature == nullptr || shortened(found.signature) != arguments) {
        const std::string got = found.signature == nullptr ? "nothing" : found.signature;
        throw std::runtime_error("the engine cannot call " + full + " of this SciPy: it takes " + got);
    }
    pointer = reinterpret_cast<Routine>(found.routine);
}

}  // namespace

void load(Found (*find)(const char*, const char*)) {
    const char* blas = "scipy.linalg.cython_blas";
    const char* lapack = "scipy.linalg.cython_lapack";
    fill(dgemm, find, blas, "dgemm", "cciiiddididdi");
    fill(dsyrk, find, blas, "dsyrk", "cciiddiddi");
    fill(dtrsm, find, blas, "dtrsm", "cccciiddidi");
    fill(dtrmm, find, blas, "dtrmm", "cccciiddidi");
    fill(dgemv, find, blas, "dgemv", "ciiddididdi");
    fill(dpotrf, find, lapack, "dpotrf", "cidii");
    fill(dpotri, find, lapack, "dpotri", "cidii");
    fill(dpstrf, find, lapack, "dpstrf", "cidiiiddi");
}

}  // namespace ekfslam::lapack
