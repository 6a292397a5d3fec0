// Instantiates the function templates that tree/precompiled.hpp declares.
#define CKC_EIGEN_TEMPLATE template
#include "tree/precompiled.hpp"
