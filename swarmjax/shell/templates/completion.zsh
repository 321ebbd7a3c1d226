#compdef swarmjax
# Completes the words of swarmjax in zsh. Written by: swarmjax --completion zsh

_swarmjax_commands='@COMMANDS@'

_swarmjax_table='@TABLE@'

# Offers the next part, up to the next dot, of each key of command $1.
_swarmjax_keys() {
    local line rest
    local -a words parts keys
    for line in ${(f)_swarmjax_table}; do
        words=(${=line})
        [[ $words[1] == $1 && $words[2] == "$PREFIX"* ]] || continue
        rest=${words[2]#"$PREFIX"}
        if [[ $rest == *.* ]]; then
            parts+=("$PREFIX${rest%%.*}.")
        else
            keys+=("$words[2]=")
        fi
    done
    parts=(${(u)parts})
    compadd -S '' -a keys
    compadd -S '' -a parts
}

# Offers the values of key $2 of command $1.
_swarmjax_values() {
    local line
    local -a words values
    for line in ${(f)_swarmjax_table}; do
        words=(${=line})
        [[ $words[1] == $1 && $words[2] == $2 ]] || continue
        values=(${words[3,-1]})
    done
    compadd -- ${values:#@file}
    (( $values[(Ie)@file] )) && _files
}

_swarmjax() {
    local line key
    local -a commands
    if (( CURRENT == 2 )); then
        for line in ${(f)_swarmjax_commands}; do
            commands+=("${line%% *}:${line#* }")
        done
        _describe command commands
        [[ $PREFIX == -* ]] && compadd -- --help --version --completion
    elif [[ $words[2] == --completion ]]; then
        compadd bash zsh fish
    elif [[ $PREFIX == -* ]]; then
        compadd -- --help
    elif [[ $PREFIX == *=* ]]; then
        key=${PREFIX%%=*}
        compset -P '[^=]#='
        _swarmjax_values $words[2] $key
    else
        _swarmjax_keys $words[2]
    fi
}

# In a folder of fpath, zsh runs this file as the function itself. When sourced, it registers it.
if [[ $funcstack[1] == _swarmjax ]]; then
    _swarmjax "$@"
else
    compdef _swarmjax swarmjax
fi
