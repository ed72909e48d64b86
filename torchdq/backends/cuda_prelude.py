"""CUDA C++ at the top of every kernel; the same text is CUDA, HIP, and C for the host, on which kernels are tested.

Six macros decide what it is compiled for. On a GPU, `EACH` is a barrier, and every thread executes what follows it. On
the host, `EACH` is a loop over the threads of a block, so that the end of a loop is the barrier; `REVERSED` runs the
threads from the last to the first, and must give the same bits.

Sine and cosine are those of the C backend. Angles that are very large or not finite take the library's.
"""

from torchdq.backends.c_constants import DOUBLE, FLOAT, TURN
from torchdq.backends.emitter import Dialect, functions

# the same words in single and in double precision
CUDA = Dialect(
    *("S", lambda x: f"((S){x.hex()})", "real(NAN_BITS)", "real(INFINITE_BITS)", "library_{}".format),
    turn="const Turn t{sin} = turn({angle}); const S {sin} = t{sin}.sin, {cos} = t{sin}.cos;",
)
_BITS_DOUBLE = """#define NAN_BITS 0x7ff8000000000000LL
#define INFINITE_BITS 0x7ff0000000000000LL
"""
_BITS_FLOAT = """#define SINGLE
#define NAN_BITS 0x7fc00000
#define INFINITE_BITS 0x7f800000
"""

_TARGET = """
#ifdef HOST
#include <math.h>
#include <string.h>
#define DEVICE static inline
#define APART static __attribute__((noinline))
#define STAGE
#define UNROLL(n)
#ifdef REVERSED
#define EACH for(int t=BLOCK-1;t>=0;t--)
#else
#define EACH for(int t=0;t<BLOCK;t++)
#endif
#define KERNEL(...) void run(long long samples,__VA_ARGS__){for(long long block=0;block*BLOCK<samples;block++){
static inline N bits(S x){N i;memcpy(&i,&x,sizeof x);return i;}
static inline S real(N i){S x;memcpy(&x,&i,sizeof x);return x;}
static void library_sincos(S x,S*s,S*c){*s=library_sin(x);*c=library_cos(x);}
#else
#ifdef SINGLE
#define library_sincos sincosf
#else
#define library_sincos sincos
#endif
#define DEVICE static __device__ __forceinline__
#define APART static __device__ __noinline__
#define STAGE __shared__
#define PRAGMA(x) _Pragma(#x)
#define UNROLL(n) PRAGMA(unroll n)
#define EACH __syncthreads();
#define KERNEL(...) extern "C" __global__ void __launch_bounds__(BLOCK) run(long long samples,__VA_ARGS__){\\
  const int t=threadIdx.x;const long long block=blockIdx.x;{
#ifdef SINGLE
DEVICE N bits(S x){return __float_as_int(x);}
DEVICE S real(N i){return __int_as_float(i);}
#else
DEVICE N bits(S x){return __double_as_longlong(x);}
DEVICE S real(N i){return __longlong_as_double(i);}
#endif
#endif
"""

# the library's function returns a pair: a pointer to the results would put every sine into memory
_FUNCTIONS = """
typedef struct{S sin,cos;}Turn;
APART Turn rare(S x){Turn y;library_sincos(x,&y.sin,&y.cos);return y;}
DEVICE Turn turn(S x){
@TURN@
  N q=bits(t);
  S a=q&1?cr:sr,b=q&1?sr:cr;
  const int top=8*sizeof(S)-1;
  Turn y={real(bits(a)^((q>>1&1)<<top)),real(bits(b)^(((q+1)>>1&1)<<top))};
  if(!(x<=LARGEST&&x>=-LARGEST))y=rare(x);
  return y;
}
""".replace("@TURN@\n", TURN.replace("T ", "S "))


def text(single: bool, block: int) -> str:
    """Text at the top of a kernel in single or double precision, with blocks of so many threads."""
    constants, bits = (FLOAT, _BITS_FLOAT) if single else (DOUBLE, _BITS_DOUBLE)
    library = "".join(f"#define library_{name} {name}{'f' if single else ''}\n" for name in functions())
    return f"{constants}{library}{bits}#define BLOCK {block}\n{_TARGET}{_FUNCTIONS}"
