// Torques and accelerations of a Pinocchio model as functions of CasADi, as `pinocchio.casadi` makes them; see export.py.
//
//     export_pinocchio MODEL.xml FOLDER
//
// MODEL.xml is what `saveToXML` of a model writes; FOLDER/rnea.casadi and FOLDER/aba.casadi are written.
#include <pinocchio/autodiff/casadi.hpp>
#include <pinocchio/multibody.hpp>
#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/serialization.hpp>
#include <casadi/casadi.hpp>
#include <string>

using casadi::SX;
using Row = Eigen::Matrix<SX, Eigen::Dynamic, 1>;

static Row row(const SX &x)
{
    Row found(x.size1());
    for (int i = 0; i < x.size1(); i++) found[i] = x(i);
    return found;
}

int main(int, char **argv)
{
    pinocchio::Model model;
    pinocchio::serialization::loadFromXML(model, argv[1], "model");
    const pinocchio::ModelTpl<SX> symbolic = model.cast<SX>();
    pinocchio::DataTpl<SX> data(symbolic);
    const SX q = SX::sym("q", model.nq), qd = SX::sym("qd", model.nv), x = SX::sym("x", model.nv);
    const auto save = [&](const std::string &name, const Row &y) {
        SX column = SX::zeros(model.nv, 1);
        for (int i = 0; i < model.nv; i++) column(i) = y[i];
        casadi::Function(name, {q, qd, x}, {column}).save(std::string(argv[2]) + "/" + name + ".casadi");
    };
    save("rnea", pinocchio::rnea(symbolic, data, row(q), row(qd), row(x)));
    save("aba", pinocchio::aba(symbolic, data, row(q), row(qd), row(x), pinocchio::Convention::LOCAL));
}
