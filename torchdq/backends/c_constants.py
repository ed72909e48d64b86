"""C constants of the elementary functions, for kernels of vectors and of single numbers alike."""

# sine sr and cosine cr of what is left of an angle x after k quarters of a turn; T is a number or a vector
TURN = """  T t = x * TWO_OVER_PI + ROUND, k = t - ROUND;
  T r = ((x - k * HALF_PI_1) - k * HALF_PI_2) - k * HALF_PI_3, z = r * r;
  T sr = r + r * z * SIN(z), h = z * (S)0.5, w = 1 - h, cr = w + (((1 - w) - h) + z * z * COS(z));
"""

# fdlibm's minimax polynomials (Sun Microsystems 1993): sine and cosine on [-pi/4, pi/4], with pi/2 in three parts;
# r (exp r + 1)/(exp r - 1) on [-ln2/2, ln2/2] and (log(1 + s) - log(1 - s))/s on [0, 0.1716], with ln2 in two parts;
# (tanh x - x)/x^3 on [0, 5/8] as P/Q (Cephes, Moshier 1992)
SINES_DOUBLE = """
#define HALF_PI_1 0x1.921fb54400000p+0
#define HALF_PI_2 0x1.0b4611a600000p-34
#define HALF_PI_3 0x1.3198a2e037073p-69
#define TWO_OVER_PI 0x1.45f306dc9c883p-1
#define ROUND 0x1.8p+52
#define LARGEST 1e5
#define SIN(z) (-0x1.5555555555549p-3+z*(0x1.111111110f8a6p-7+z*(-0x1.a01a019c161d5p-13+z*(0x1.71de357b1fe7dp-19 \\
  +z*(-0x1.ae5e68a2b9cebp-26+z*0x1.5d93a5acfd57cp-33)))))
#define COS(z) (0x1.555555555554cp-5+z*(-0x1.6c16c16c15177p-10+z*(0x1.a01a019cb1590p-16+z*(-0x1.27e4f809c52adp-22 \\
  +z*(0x1.1ee9ebdb4b1c4p-29+z*-0x1.8fae9be8838d4p-37)))))
"""
DOUBLE = f"""
typedef double S;
#define SIZE 8
typedef long long N;
{SINES_DOUBLE}
#define MANTISSA 52
#define BIAS 1023
#define SMALLEST 0x1p-1022
#define GREATEST 0x1.fffffffffffffp+1023
#define LOWEST -746.0
#define HIGHEST 710.0
#define ROOT_HALF 0x3fe6a09e667f3bcdLL
#define LN2_1 0x1.62e42feep-1
#define LN2_2 0x1.a39ef35793c76p-33
#define ONE_OVER_LN2 0x1.71547652b82fep+0
#define EXP(z) (1.66666666666666019037e-01+z*(-2.77777777770155933842e-03+z*(6.61375632143793436117e-05 \\
  +z*(-1.65339022054652515390e-06+z*4.13813679705723846039e-08))))
#define TANH_P(z) (-1.61468768441708447952e+03+z*(-9.92877231001918586564e+01+z*-9.64399179425052238628e-01))
#define TANH_Q(z) (4.84406305325125486048e+03+z*(2.23548839060100448583e+03+z*(1.12811678491632931402e+02+z)))
#define LOG(z,w) (w*(3.999999999940941908e-01+w*(2.222219843214978396e-01+w*1.531383769920937332e-01)) \\
  +z*(6.666666666666735130e-01+w*(2.857142874366239149e-01+w*(1.818357216161805012e-01+w*1.479819860511658591e-01))))
"""

# the same in single precision (sine and cosine: Cephes, Moshier 1992; the others: FreeBSD's fdlibm)
SINES_FLOAT = """
#define HALF_PI_1 0x1.92p+0f
#define HALF_PI_2 0x1.fb4p-12f
#define HALF_PI_3 0x1.4442d2p-24f
#define TWO_OVER_PI 0x1.45f306p-1f
#define ROUND 0x1.8p+23f
#define LARGEST 4e3f
#define SIN(z) (-1.6666654611e-1f+z*(8.3321608736e-3f+z*-1.9515295891e-4f))
#define COS(z) (4.166664568298827e-2f+z*(-1.388731625493765e-3f+z*2.443315711809948e-5f))
"""
FLOAT = f"""
typedef float S;
#define SIZE 4
typedef int N;
{SINES_FLOAT}
#define MANTISSA 23
#define BIAS 127
#define SMALLEST 0x1p-126f
#define GREATEST 0x1.fffffep+127f
#define LOWEST -104.0f
#define HIGHEST 89.0f
#define ROOT_HALF 0x3f3504f3
#define LN2_1 0x1.62e4p-1f
#define LN2_2 0x1.7f7d1cp-20f
#define ONE_OVER_LN2 0x1.715476p+0f
#define EXP(z) (1.6666625440e-1f+z*-2.7667332906e-3f)
#define TANH_P(z) (-3.33332819422e-1f+z*(1.33314422036e-1f+z*(-5.37397155531e-2f+z*(2.06390887954e-2f \\
  +z*-5.70498872745e-3f))))
#define TANH_Q(z) 1
#define LOG(z,w) (w*(0.40000972152f+w*0.24279078841f)+z*(0.66666662693f+w*0.28498786688f))
"""
