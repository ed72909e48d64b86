"""C code at the top of every program: vector types, functions of vectors, loads and stores of rows.

It is the same for every processor: the number of lanes follows from the compiler's target. It needs nothing but the
compiler. Sine, cosine, exponential and logarithm are computed for all lanes at once; the C library is called only for
lanes whose angle is very large or not finite. Operations without a function of vectors here take one lane after the
other.
"""

from torchdq.backends.c_constants import DOUBLE, FLOAT, TURN
from torchdq.backends.emitter import Dialect, functions
from torchdq.numbers.ops import OPS
from torchdq.program.order import TOGETHER

# numbers, and vectors of them; the same words in single and in double precision
SINGLE = Dialect("S", lambda x: f"((S){x.hex()})", '(S)__builtin_nan("")', "(S)__builtin_inf()", "library_{}".format)
VECTORS = SINGLE._replace(
    number="T",
    call="{}_".format,
    turn="T {sin}, {cos}; sincos_({angle}, &{sin}, &{cos});",
    spread="(T){{}}+{0}",
)

_PRELUDE = """
#if defined(__AVX512F__)&&!defined(FEW)
#define BYTES 64
#elif defined(__AVX__)
#define BYTES 32
#else
#define BYTES 16
#endif
#define LANES (BYTES/SIZE)
#define TILE (LANES<8?LANES:8)
typedef __INT64_TYPE__ word;
typedef S T __attribute__((vector_size(BYTES)));
typedef N M __attribute__((vector_size(BYTES)));
typedef T U __attribute__((aligned(SIZE)));
#ifdef __clang__
#define MIX(a,b,...) __builtin_shufflevector(a,b,__VA_ARGS__)
#else
#define MIX(a,b,...) __builtin_shuffle(a,b,(M){__VA_ARGS__})
#endif

@TURNS@
static inline T choose(M m,T a,T b){return (T)(((M)a&m)|((M)b&~m));}

static __attribute__((noinline)) void rare(T x,T*s,T*c){
  for(int l=0;l<LANES;l++)if(!(x[l]<=LARGEST&&x[l]>=-LARGEST)){(*s)[l]=library_sin(x[l]);(*c)[l]=library_cos(x[l]);}
}

static inline void sincos_(T x,T*s,T*c){
@TURN@
  M q=(M)t,odd=-(q&1);
  T a=choose(odd,cr,sr),b=choose(odd,sr,cr);
  const int top=8*sizeof(S)-1;
  *s=(T)((M)a^((q>>1&1)<<top));
  *c=(T)((M)b^(((q+1)>>1&1)<<top));
  M wild=~((x<=(T){}+LARGEST)&(x>=(T){}-LARGEST));
  N any=0;for(int l=0;l<LANES;l++)any|=wild[l];
  if(__builtin_expect(any!=0,0))rare(x,s,c);
}

static inline T max_(T a,T b){return choose((a>=b)|(a!=a),a,b);}
static inline T min_(T a,T b){return choose((a<=b)|(a!=a),a,b);}
static inline T select_(T m,T a,T b){return choose(m!=(T){},a,b);}
static inline T ge_(T a,T b){return (T)((a>=b)&(M)((T){}+1));}

/* rounded by adding what leaves no bits after the point; without it compilers take one lane at a time */
static inline T floor_(T x){
  const T whole=(T){}+(S)((N)1<<MANTISSA);
  const M sign=(M)-(T){};
  T size=(T)((M)x&~sign),y=(T)((M)((size+whole)-whole)|((M)x&sign));
  return choose(size<whole,y-(T)((y>x)&(M)((T){}+1)),x);
}

/* scaled by a power of two in two steps, of which the second rounds to what is subnormal, zero or infinite */
static inline T exp_(T x){
  const T least=(T){}+LOWEST,most=(T){}+HIGHEST;
  x=choose(x<least,least,choose(x>most,most,x));
  T k=(x*ONE_OVER_LN2+ROUND)-ROUND,half=k*(S)0.5+ROUND,rest=(k-(half-ROUND))+ROUND;
  T h=x-k*LN2_1,l=k*LN2_2,r=h-l,z=r*r,c=r-z*EXP(z);
  T y=1-((l-(r*c)/(2-c))-h);
  return y*(T)(((M)half+BIAS)<<MANTISSA)*(T)(((M)rest+BIAS)<<MANTISSA);
}

/* one division: x + x^3 P/Q near zero, and 1 - 2e/(1 + e), e = exp(-2x), beyond */
static inline T tanh_(T x){
  const M sign=(M)-(T){};
  T size=(T)((M)x&~sign),z=x*x,e=exp_(size*(S)-2);
  M near=size<(T){}+(S)0.625;
  T y=choose(near,size,(T){}+1)+choose(near,size*z*TANH_P(z),e*(S)-2)/choose(near,(T){}+TANH_Q(z),1+e);
  return (T)((M)y|((M)x&sign));
}

/* x = 2^k (1 + f), 1 + f between the roots of 1/2 and 2 */
static inline T log_(T x){
  const N up=(N)BIAS<<MANTISSA;
  const S whole=(S)((N)1<<MANTISSA);
  M tiny=x<(T){}+SMALLEST;
  M i=(M)choose(tiny,x*(whole*4),x),e=((i-ROOT_HALF+up)>>MANTISSA)&(2*BIAS+1);
  T k=(T)(e|(M)((T){}+whole))-(whole+BIAS)-choose(tiny,(T){}+(MANTISSA+2),(T){});
  T f=(T)(i-((e-BIAS)<<MANTISSA))-1,s=f/(2+f),z=s*s,w=z*z,h=(S)0.5*f*f;
  T y=k*LN2_1-((h-(s*(h+LOG(z,w))+k*LN2_2))-f);
  T other=choose(x<(T){},(T){}+(S)__builtin_nan(""),choose(x==(T){},(T){}-(S)__builtin_inf(),x));
  return choose((x>(T){})&(x<=(T){}+GREATEST),y,other);
}
""".replace("@TURN@\n", TURN)


def text(single: bool, few: bool = False) -> str:
    """C code at the top of a program in single or double precision, with shorter vectors for a few samples."""
    constants, suffix = (FLOAT, "f") if single else (DOUBLE, "")
    library = "".join(f"#define library_{name} __builtin_{name}{suffix}\n" for name in functions())
    return f"{'#define FEW' * few}\n{constants}{library}\n{_PRELUDE.replace('@TURNS@', _turns())}{_lane_by_lane()}"


def _lane_by_lane() -> str:
    """C functions of vectors for the operations that have none above."""
    lines = []
    for code, row in OPS.items():
        if not row.infix and code not in TOGETHER and f"T {code}_(" not in _PRELUDE:
            operands = [f"x{k}" for k in range(len(row.partials))]
            value = SINGLE.applied(code, [f"{x}[l]" for x in operands])
            lines.append(
                f"static inline T {code}_({', '.join(f'T {x}' for x in operands)})"
                f"{{T y;for(int l=0;l<LANES;l++)y[l]={value};return y;}}\n"
            )
    return "".join(lines)


def _turns() -> str:
    """C functions that transpose a tile held in vectors: TILE columns of LANES samples.

    Vector k holds row k in its first TILE lanes, and row k + TILE in the next, if there are more. Blocks of half the
    size are swapped across the diagonal, then blocks of a quarter, down to single entries.
    """
    text = []
    for lanes in (2, 4, 8, 16):
        tile = min(lanes, 8)
        steps = []
        size = tile // 2
        while size:
            for i in range(tile):
                if not i & size:
                    low = [k if not k & size else lanes + k - size for k in range(lanes)]
                    high = [k + size if not k & size else lanes + k for k in range(lanes)]
                    steps.append(
                        f"t=MIX(r[{i}],r[{i + size}],{','.join(map(str, low))});"
                        f"r[{i + size}]=MIX(r[{i}],r[{i + size}],{','.join(map(str, high))});r[{i}]=t;"
                    )
            size //= 2
        text.append(f"#if LANES=={lanes}\nstatic inline void turn(T*r){{T t;{''.join(steps)}}}\n#endif")
    return "\n".join(text) + _TILES


# rows narrower than a tile are read beyond their end, into the next rows; they are written in order, so that the next
# row overwrites what the last one wrote into it, and never beyond the end of the array
_TILES = """
#if LANES==16
typedef S H __attribute__((vector_size(32)));
typedef H V __attribute__((aligned(SIZE)));
#if defined(__has_builtin)
#if __has_builtin(__builtin_shufflevector)
#define PAIR
#endif
#endif
static inline T row(const S*at,word stride){
#ifdef PAIR
  return __builtin_shufflevector(*(const V*)at,*(const V*)(at+8*stride),0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15);
#else
  union{H h[2];T t;}u={{*(const V*)at,*(const V*)(at+8*stride)}};return u.t;
#endif
}
static inline H part(T v,int half){
#ifdef PAIR
  return half?__builtin_shufflevector(v,v,8,9,10,11,12,13,14,15):__builtin_shufflevector(v,v,0,1,2,3,4,5,6,7);
#else
  union{T t;H h[2];}u={v};return u.h[half];
#endif
}
static inline void put(S*at,T v,int half,int count,int whole){
  H x=part(v,half);
  if(whole)*(V*)at=x;else for(int j=0;j<count;j++)at[j]=x[j];
}
#else
static inline T row(const S*at,word stride){return *(const U*)at;}
static inline void put(S*at,T v,int half,int count,int whole){
  if(whole)*(U*)at=v;else for(int j=0;j<count;j++)at[j]=v[j];
}
#endif
static inline void load(T*to,const S*from,int width){
  if(width==1){to[0]=*(const U*)from;return;}
  for(int c=0;c<width;c+=TILE){
    const int at=width<TILE?0:(c>width-TILE?width-TILE:c);
    T r[TILE];
    for(int k=0;k<TILE;k++)r[k]=row(from+k*width+at,width);
    turn(r);
    for(int k=0;k<TILE&&k<width;k++)to[at+k]=r[k];
  }
}
static inline void store(S*to,const T*from,int width){
  if(width==1){*(U*)to=from[0];return;}
  for(int c=0;c<width;c+=TILE){
    const int at=width<TILE?0:(c>width-TILE?width-TILE:c),count=width<TILE?width:TILE;
    T r[TILE];
    for(int k=0;k<TILE;k++)r[k]=from[at+(k<count?k:0)];
    turn(r);
    for(int l=0;l<LANES;l++)put(to+l*width+at,r[l%TILE],l/TILE,count,l*width+at+TILE<=LANES*width);
  }
}
"""
