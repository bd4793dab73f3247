// The joint covariance in the conditional form: exact, and linear in the number of landmarks.
//
// Landmarks are independent of each other given A: the views of a window of frames, columns of the body on which they
// depend directly (front), and a few promoted landmarks. With e, all other columns of the body and considered ones:
//
//     N((x_A, x_e); 0, P) prod_i N(d_i; K_i x_A, S_i)
//
// A promoted landmark is part of A. With rows r_i = H_x x_A + H_m d_i + v, eq. (6) is
//
//     R_i = H_m S_i H_m^T + V = L_i L_i^T     B_i = L_i^-1 (H_x + H_m K_i)     w_i = L_i^-1 r_i
//     P_AA = F F^T    F_e = P_eA F^-T         T = B F    M = I + T^T T = C C^T      y = M^-1 T^T w
//     P_AA+ = W W^T, W = F C^-T               P_eA+ = F_e C^-T W^T    P_ee+ = P_ee - F_e (I - M^-1) F_e^T
//     x_A = F y     x_e = F_e y               d_i = K_i x_A + G_i (w_i - T_i y),    G_i = S_i H_m^T L_i^-T
//     K_i+ = K_i - G_i B_i                    S_i+ = S_i - G_i G_i^T
//
// and S^-1 = L^-T (I - T M^-1 T^T) L^-1. Columns of A are in this order, so that B_i and T_i (F is upper triangular)
// are zero before the first view of landmark i: promoted landmarks, views from the oldest to z', z, zd, front, anchor.
#pragma once

#include <algorithm>
#include <optional>

#include "dormant.hpp"
#include "root.hpp"
#include "types.hpp"

namespace ekfslam {

// Columns of the body in the layout of the model. All body matrices and vectors of the interface have this layout.
// A model without a block `view` has a view inside of the covariance all the same; its `at` is -1.
struct Columns {
    Index body = 0;       // all blocks, views included
    Index view = -1;      // first column of the block `view`
    Index previous = -1;  // of `previous_view`
    Index anchor = -1;    // of `anchor`
    Slots front;          // columns of the body (no view) on which rows depend directly
};

// Whitened rows of k landmarks over A, one column a row, with what both gates need. The columns of T^T are sorted by
// the first of their rows that is not zero: T^T is a staircase.
struct Projection {
    Rows rows;
    std::vector<double> L;  // (k) lower (d, d), column-major
    Matrix T, G;            // T^T (f, k d), G (3, k d)
    Slots begin;            // (k) first row of a landmark's columns of T^T that is not zero
    Slots place;            // (k) of each landmark in T^T

    Projection only(const Slots& which) const;
    void keep(const Slots& which);                 // ascending, in place
    Eigen::Block<const Matrix> of(Index i) const;  // (f - begin, d) columns of T^T of landmark i
    Eigen::Map<const Matrix> root(Index i) const;  // L_i
    Matrix own_variance(Index i) const;            // (d, d) of H P H^T for landmark i
    Matrix S() const;                              // (k d, k d) joint covariance of the innovations, V included
};

// Eq. (6) solved for projected rows, all or some of them; or for rows of the body alone.
struct Solution {
    Projection at;
    Flags left;            // which landmarks are in it
    Matrix M, C;           // (f, f) in their lower triangles
    Matrix w, v;           // (d, k) L^-1 r, and w - T y of the rows that are left
    Vector y;              // (f)
    Matrix V_A, V_e, H_e;  // of rows of the body, whitened by their S: P_A: H^T, P_e: H^T (e, k), and H_e (k, e)
    double nis = 0.0, log_det = 0.0;

    // (d, k) residuals that the correction leaves in the rows that are left, V S^-1 r; 0 in others.
    Matrix residual() const;
};

class Gaussian {
   public:
    Gaussian(const Matrix& P_body, Columns columns);

    const Columns& columns() const { return columns_; }
    Lead lead() const;                                 // of rows in the present frame
    Index landmarks() const { return size_of(row_); }  // in the table's order, dormant ones included
    Index considered() const { return considered_; }

    Matrix body_covariance() const;                  // (body + considered)
    Matrix covariance_of(const Slots& slots) const;  // (body + considered + 3k)
    std::vector<Matrix3> landmark_blocks(const Slots& slots) const;

    // Eq. (2) on the body; views stay.
    void propagate(const Matrix& Phi, const Matrix& Q);
    // previous_view <- view, at the start of a prediction.
    void close_view();
    // view <- Y x, and the drifted view <- Yd x if given; Y, Yd (6, body) with zeros at views. Promotes landmarks and
    // drops old views first, so that A becomes smallest. Each prediction of any model ends with it.
    void open_view(const Matrix& Y, const std::optional<Matrix>& Yd);
    // anchor <- view; landmarks that depend on the old anchor keep its columns in the window.
    void hold_anchor();
    // Adds Q (body, body) to the body, and to the views of this frame through Y and Yd; before their first update.
    void add_noise(const Matrix& Q);

    Projection project(Rows rows) const;
    Solution solve(Projection at) const;
    Solution without(Solution solution, const Flags& out) const;
    Solution solve_body(const Matrix& H, const Vector& residual, const Vector& variance) const;  // H (k, body)
    // Correction (body + considered + 3n) of the mean; asked for before `apply`.
    Vector correction(const Solution& solution) const;
    std::vector<Matrix> given_others(const Solution& s, const Slots& which) const;  // V^1/2 (S^-1)_ii V^1/2, (d, d)
    Matrix information(const Solution& s, const Matrix& J) const;  // J^T S^-1 J for J (j d, c) of the j that are left
    void apply(const Solution& solution);

    // Landmarks d = G x_lead + w, eq. (5): G (lead, 3n), one column a coordinate; covariances of w.
    void augment(const Matrix& G, const std::vector<Matrix3>& covariance);
    // z <- A z for the view in layout columns `at` (view, previous or anchor), or another part of the body.
    void transform_body(Index at, const Matrix& A);
    // d_i <- M_i d_i + B_i z for the view in layout columns `at`; M empty: identity.
    void transform_landmarks(const Slots& slots, const std::vector<Matrix3>& M, const std::vector<Matrix36>& B,
                             Index at);
    void rest(const Flags& asleep);
    void marginalise(const Flags& stay);
    void replace(const Matrix& P);  // (body + considered + 3n): all landmarks promoted, none asleep

    Index consider(Index columns);                   // considered columns for clones; the first one, from `body` on
    void clone(Index source, Index size, Index to);  // body columns into considered ones

   private:
    // A view of the layout is E x at columns of A: two layouts may share columns, and none of them has to be
    // re-expressed.
    struct View {
        Index column = -1;
        Matrix6 E = Matrix6::Identity();
    };
    struct Awake {
        Index slot = 0;
        Index own = -1;         // first column of A if promoted
        Index begin = 0;        // first column of A on which it depends
        std::vector<double> K;  // K_i^T (n_A - begin, 3) of a landmark that is not promoted
        Matrix3 S = Matrix3::Zero();
        Matrix3 A = Matrix3::Identity();  // K_i is A K in so many first columns, which have not been multiplied yet
        Index waiting = 0;
    };
    struct Part {  // leading columns of rows from `row` on, and where they are in A
        Index row, column, size;
        const View* view;
    };
    using Parts = std::vector<Part>;
    struct Over {  // the same rows over A and over e
        Matrix A, e;
    };
    using Tail = Eigen::Map<Eigen::Matrix<double, Eigen::Dynamic, 3>>;

    // gaussian.cpp
    Parts parts() const;
    // The first column of A, from `begin` at the latest, that columns H (lead, w) depend on.
    static Index first_column(const Parts& parts, const Eigen::Ref<const Matrix>& H, Index begin);
    Over over(const Matrix& H) const;      // rows H (k, body) over the columns of A and e
    Slots body_places() const;             // places of body and considered columns in [A, e]
    double entry(Index i, Index j) const;  // of P over [A, e]
    Matrix gathered(const Slots& rows, const Slots& columns) const;
    const View* view_at(Index at) const;
    View* view_at(Index at);
    void turn_views(Matrix& P) const;                 // E of each view to rows and columns of a body covariance
    Matrix dependence(const Slots& slots) const;      // K^T (n_A, 3k)
    Matrix own_covariance(const Slots& slots) const;  // (3k, 3k) of d given A
    Slots dormant_of(const Slots& slots) const;
    void transform_columns(const Slots& at, const Matrix& A);

    // window.cpp
    Tail tail(const Awake& landmark) const;    // K_i^T
    Tail recent(const Awake& landmark) const;  // its rows from the view of the frame before on, K_i^T or shorter
    void turn(Awake& landmark, const Matrix3& A) const;  // K_i <- A K_i
    void extend(Awake& landmark, Index begin) const;
    void move(Awake& landmark, const Slots& first) const;
    bool is_used(Index column, Index size) const;
    void rearrange(const Slots& from);
    Matrix release(const Slots& leaving);  // covariance (o, 3n) of the columns with what K_B leaves
    void drop(const Slots& leaving);
    Slots cut();
    void open_again();
    void restore_views();
    void promote(const Slots& rows);
    Index join(const Matrix& K, const Matrix& S, const Matrix& cross);
    void enter(Index column, const Matrix& Y);
    void absorb(const Slots& entered, const Matrix& cross);
    void push_front(const Slots& changed);
    Index front_at() const { return P_AA_.rows() - (has_anchor_ ? 6 : 0) - front_size(); }
    Index front_size() const { return size_of(columns_.front); }
    Index view_column() const { return front_at() - (has_drifted_ ? 12 : 6); }
    // Columns of this frame and the frame before begin here.
    Index recent_column() const {
        return previous_.column >= promoted_ ? std::min(view_column(), previous_.column) : view_column();
    }

    // landmarks.cpp
    void wake(const Flags& wakes);
    void forget(const Flags& gone);
    struct Change {  // x_own <- M x_own + B z for a promoted landmark
        Index own;
        Matrix3 M;
        Matrix36 B;
    };
    void transform_promoted(const std::vector<Change>& changes, Index view);
    void transform_dormant(Index which, const Matrix3& M, const Matrix36& B, Index view);
    void number();

    // project.cpp, solve.cpp
    const Root& root() const;
    Matrix by_columns(Matrix H_x) const;  // rows (lead, m) by the columns of A
    bool whiten(Projection& at, Index i, const Matrix& H_x, const Parts& parts) const;
    void solve_left(Solution& solution) const;
    void apply_rows(const Solution& solution, Index i, const Matrix& H_x, const Parts& parts);
    void apply_body(const Solution& solution);

    Columns columns_;
    Slots rest_;  // layout columns of e, considered ones not included
    Index considered_ = 0;
    Matrix P_AA_, P_eA_, P_ee_;
    View view_, previous_, anchor_;
    Slots groups_;                                   // widths of views in the window, from the oldest
    Index promoted_ = 0;                             // columns of promoted landmarks
    bool has_drifted_ = false, has_anchor_ = false;  // whether A has columns of zd, and of an anchor of its own
    Matrix Y_, Yd_;
    std::vector<Awake> awake_;
    Slots row_;  // of each slot, in `awake_`; -1: dormant
    Dormant dormant_;
    mutable std::optional<Root> root_;
    mutable Matrix F_e_;
};

}  // namespace ekfslam
